"""The command line: `commands.py` parses, the other modules print."""

from heli_jax.cli.commands import main

__all__ = ["main"]
