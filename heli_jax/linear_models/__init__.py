"""Derivative models as files: a linear model from YAML (docs/linear-models.md).

`expression.py` is the arithmetic of an entry, `content.py` checks what a file says,
`equations.py` makes a Model of it, `read.py` finds the file and remembers what it read.
"""
