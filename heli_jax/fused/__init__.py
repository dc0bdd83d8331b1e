"""A loop over time as one program: what JAX traced, translated to LLVM, vehicles side by side.

XLA makes a kernel of each step and goes to memory between them; here the states of some vehicles
stay in registers from the first sample to the last, as in C that is written by hand.
"""
