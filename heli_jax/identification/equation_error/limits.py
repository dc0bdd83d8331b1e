"""The limit of a stepwise regression; in a file of its own, since a configuration states it too."""

F_ENTER = 20.0
"""five times the 5 % point of F (Klein and Morelli): terms below it hardly help to predict"""
