"""Derivative models as files: a linear model from YAML (docs/linear-models.md).

`expression.py` has the arithmetic of entries, `content.py` checks a file, `matrices.py` checks its
matrices, and `read.py` reads files, makes Models and caches them.
"""
