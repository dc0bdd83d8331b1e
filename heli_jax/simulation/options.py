"""Options of a simulation in one record."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax as dfx
from jaxtyping import Array

from heli_jax.errors import nearest
from heli_jax.naming import Number, Record
from heli_jax.simulation.events import Event
from heli_jax.simulation.hold import Hold


class SimulationOptions(NamedTuple):
    """Options of `simulate` and `accumulate`; each field is also a keyword of theirs."""

    # Any, as a number that is never None once a run has begun: the Flight has one, or it is
    # refused.
    dt: Any = None
    """sample time [s]; that of the Flight unless given"""
    initial_state: Record | None = None
    """the model's State at the first sample; `model.initial_state` unless given"""
    solver: str | dfx.AbstractSolver | None = None
    """"exact" (linear models, the default there), "rk4" (the default elsewhere), or any diffrax
    solver"""
    substeps: int = 4
    """steps per sample of a fixed-step solver"""
    controller: dfx.AbstractStepSizeController | None = None
    """a diffrax step-size controller makes the steps adaptive, with Dopri8 unless another solver
    is given; they end at every sample"""
    delay: Number | None = None
    """the inputs act this much later (+) or earlier (-) than given [s]; differentiable. Before the
    first sample its value holds, after the last the last one's"""
    adjoint: dfx.AbstractAdjoint | None = None
    """`diffrax.DirectAdjoint()` unless given: forward and reverse mode both work. `ForwardMode()`
    compiles faster, `RecursiveCheckpointAdjoint()` saves memory in reverse mode"""
    max_steps: int = 4096
    """bound on adaptive steps a sample; where it ends a run, `result` says so"""
    key: Array | None = None
    """a JAX random key: the model's process noise is drawn with it, by the discrete process noise
    of a sample: exact for linear models with solver "exact", of the model linearised at each sample
    for others with fixed steps; without it there is none"""
    block: int = 1
    """samples per step of solver "exact". A single record: 32 is three times as fast as 1; large
    batches: 1 is best for `simulate`, 4 for `accumulate` (64 side by side on a CPU)"""
    feedback: Callable[[Any, Any], Any] | None = None
    """feedback(state, inputs) -> Inputs that act, once a sample; `inputs` are the given ones at
    that sample (references, or what is added)"""
    events: Mapping[str, Event] | None = None
    """by name, event(params, state, inputs) -> a number that is above zero while the run goes on
    (see `heli_jax.simulation.events`). The first to fall to zero or below ends the run: from there
    on the state stays as it was at that moment"""
    hold: Hold = None
    """what the inputs do between samples: "zero-order" (each sample stays until the next) or
    "linear" (straight lines), for all or by input. Unless given, as the Flight says; given as
    arrays they stay"""

    def changed(self, keywords: Mapping[str, Any]) -> "SimulationOptions":
        """These options with some fields given as keywords.

        Raises:
            TypeError: a keyword that is no field.
        """
        # `_replace` refuses an unknown field too, without saying which one was meant.
        for name in keywords:
            if name not in self._fields:
                raise TypeError(
                    f"expected a field of SimulationOptions, got {name!r}"
                    f"{nearest(name, self._fields)}"
                )
        return self._replace(**keywords)


DEFAULT = SimulationOptions()
