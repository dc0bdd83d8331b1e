"""Loops over time as one program: JAX traces, translated to LLVM, with vehicles in vector lanes.

XLA makes a kernel of each step and stores states in memory between them. Here the states of some
vehicles stay in registers from the first sample to the last, as in hand-written C.
"""
