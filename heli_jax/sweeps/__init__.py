"""Sweeps: many runs of one model, reduced to numbers, stored in chunks that survive a kill.

A design sets the values of the axes for each element (design point); reducers compute the results
of each run. `sweep` computes chunks of elements and writes each when it is done.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from heli_jax.sweeps.design import Design as Design
    from heli_jax.sweeps.design import Range as Range
    from heli_jax.sweeps.design import grid as grid
    from heli_jax.sweeps.design import lhs as lhs
    from heli_jax.sweeps.design import paired as paired
    from heli_jax.sweeps.design import product as product
    from heli_jax.sweeps.design import sobol as sobol
    from heli_jax.sweeps.design import table as table
    from heli_jax.sweeps.design import zipped as zipped
    from heli_jax.sweeps.reducers import Reduce as Reduce
    from heli_jax.sweeps.reducers import Streaming as Streaming
    from heli_jax.sweeps.run import sweep as sweep
    from heli_jax.sweeps.spec import Trajectories as Trajectories
    from heli_jax.sweeps.spec import Trimmed as Trimmed

# Loaded on first use: the store's libraries take a second that other commands do not need.
_HOMES = {
    **dict.fromkeys(
        ("Design", "Range", "grid", "lhs", "paired", "product", "sobol", "table", "zipped"),
        "design",
    ),
    **dict.fromkeys(("Trajectories", "Trimmed"), "spec"),
    **dict.fromkeys(("Reduce", "Streaming"), "reducers"),
    "sweep": "run",
}
__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'heli_jax.sweeps' has no attribute {name!r}")
    return getattr(importlib.import_module(f"heli_jax.sweeps.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
