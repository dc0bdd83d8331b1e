"""Sweeps: many runs of one model, reduced to numbers, on disk, in pieces that survive a kill.

A design says which values the axes take, element by element; reducers say what is kept of each
run; `sweep` computes chunks of elements and writes each when it is done.
"""

from heli_jax.sweeps.design import (
    Between,
    Design,
    grid,
    lhs,
    listed,
    product,
    sobol,
    table,
    zipped,
)
from heli_jax.sweeps.job import Trajectories, Trimmed
from heli_jax.sweeps.reducers import Reduce, Streaming
from heli_jax.sweeps.run import sweep

__all__ = [
    "Between",
    "Design",
    "Reduce",
    "Streaming",
    "Trajectories",
    "Trimmed",
    "grid",
    "lhs",
    "listed",
    "product",
    "sobol",
    "sweep",
    "table",
    "zipped",
]
