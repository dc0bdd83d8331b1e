"""Numerical code that replaces a library because it is measurably faster.

Each file names the benchmark that justifies it. If the gain disappears, use the library's function
again.
"""
