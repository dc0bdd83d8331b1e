"""Options of a simulation in one record."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax as dfx
from jaxtyping import Array

from heli_jax.errors import nearest
from heli_jax.naming import Number, Record
from heli_jax.simulation.events import Event
from heli_jax.simulation.hold import Hold


class Scan(dfx.DirectAdjoint):
    """Forward and reverse mode through a scan over the samples, each computed again in reverse. It
    compiles in a fraction of the time; a failed step does not end the run."""


class SimulationOptions(NamedTuple):
    """Options of `simulate` and `accumulate`; each field is also a keyword of both."""

    # Any: a number that is never None during a run, since the Flight has one or it is refused.
    dt: Any = None
    """Sample time [s]; default: that of the Flight."""
    initial_state: Record | None = None
    """The model's State at the first sample; default: `model.initial_state`."""
    solver: str | dfx.AbstractSolver | None = None
    """"exact" (default for linear models), "rk4" (default for others), or any diffrax solver."""
    substeps: int = 4
    """Steps per sample of a fixed-step solver."""
    controller: dfx.AbstractStepSizeController | None = None
    """diffrax step-size controller for adaptive steps, which end at every sample. The default
    solver is then Dopri8.
    """
    delay: Number | None = None
    """Delay of the inputs [s], differentiable; negative values advance them. Beyond the record the
    first or last value is held.
    """
    adjoint: dfx.AbstractAdjoint | None = None
    """Default: `diffrax.DirectAdjoint()`, for forward and reverse mode. `ForwardMode()` compiles
    faster, `RecursiveCheckpointAdjoint()` saves memory in reverse mode, `Scan()` both.
    """
    max_steps: int = 4096
    """Limit of adaptive steps per sample; `result` shows if it was reached."""
    key: Array | None = None
    """JAX random key for the model's process noise; without it there is none.

    Noise has the discrete covariance of a sample. This is exact for linear models with solver
    "exact"; other models are linearised at each sample, with fixed steps.
    """
    block: int = 1
    """Samples per step of solver "exact". For a single record 32 is three times as fast as 1. For
    large batches 1 is best for `simulate`, 4 for `accumulate` (64 side by side on a CPU).
    """
    feedback: Callable[[Any, Any], Any] | None = None
    """feedback(state, inputs) returns the acting Inputs, once a sample. `inputs` are those given
    for that sample (references, or additions).
    """
    events: Mapping[str, Event] | None = None
    """Events by name: event(params, state, inputs) returns a number above zero while the run
    continues (see `heli_jax.simulation.events`). The first to reach zero ends the run, and the
    state is frozen from that time.
    """
    hold: Hold = None
    """Hold of the inputs between samples: "zero-order" (constant until the next sample) or "linear"
    (straight lines), for all or by input. Default: that of the Flight; plain arrays are held.
    """

    def changed(self, keywords: Mapping[str, Any]) -> "SimulationOptions":
        """Return the options with some fields changed by keywords.

        Raises:
            TypeError: an unknown field.
        """
        # `_replace` also refuses an unknown field, but suggests no name.
        for name in keywords:
            if name not in self._fields:
                raise TypeError(
                    f"expected a field of SimulationOptions, got {name!r}"
                    f"{nearest(name, self._fields)}"
                )
        return self._replace(**keywords)


DEFAULT = SimulationOptions()
