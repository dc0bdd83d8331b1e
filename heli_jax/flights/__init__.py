"""Logged runs: the only place where log files are read, units converted and clocks checked.

Any function here raises `heli_jax.errors.InputError` for a wrong file or request: one sentence with
the place, the expected and the actual content.
"""

from heli_jax.flights.describe import ColumnInfo, Gap, LogInfo, TimeInfo, describe_log
from heli_jax.flights.flight import Flight, Signal, Source
from heli_jax.flights.read import (
    read_flight,
    read_parts,
    require_moving_outputs,
)
from heli_jax.flights.request import Also, ReadOptions

__all__ = [
    "Also",
    "ColumnInfo",
    "Flight",
    "Gap",
    "LogInfo",
    "ReadOptions",
    "Signal",
    "Source",
    "TimeInfo",
    "describe_log",
    "read_flight",
    "read_parts",
    "require_moving_outputs",
]
