"""Numerical code of our own that replaces a library because it is measurably faster where it
matters.

Each file names the benchmark that justifies it. If the gain disappears, use the library's function
again.
"""
