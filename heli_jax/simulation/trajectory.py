"""Result of a simulation."""

import functools
from typing import TYPE_CHECKING, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from heli_jax.naming import Record

# Local imports: summaries and exports use this class, and a simulation needs no pandas, xarray or
# HTML.
if TYPE_CHECKING:
    import xarray as xr

STATUS = ("ok", "ended by an event", "outside the model's range", "not finite", "solver stopped")
"""Meanings of `Trajectory.status`, from best to worst."""


class Trajectory(NamedTuple):
    """A simulated run, sample by sample; vmap adds batch dimensions."""

    times: Float[Array, " N"]
    """Sample times [s], from 0."""
    states: Record
    """The model's State with arrays (N,)."""
    outputs: Record
    """The model's Outputs with arrays (N,)."""
    inputs: Record
    """The model's Inputs with arrays (N,) as they acted at each sample: with feedback added, and
    with delays applied.
    """
    result: dfx.RESULTS
    """diffrax's result: `diffrax.RESULTS.successful`, or the reason why the integration stopped."""
    finite: Bool[Array, ""]
    """True if every state is finite."""
    outside: dict[str, Bool[Array, " N"]]
    """True at samples where a limit of the model is exceeded, by name; empty for a model without
    limits.
    """
    ended: Float[Array, ""] | float
    """Time at which an event ended the run [s]; inf if none did."""
    event: Int[Array, ""] | int
    """Index of that event, in the given order; -1 if none ended the run."""

    @property
    def valid(self) -> Bool[Array, " N"]:
        """True at samples within the model's range that are finite."""
        # A run that diverges is usable up to that point.
        finite = [jnp.isfinite(v) for v in jax.tree.leaves(self.states)]
        return functools.reduce(
            jnp.logical_and, [*finite, *(~out for out in self.outside.values())]
        )

    @property
    def status(self) -> Int[Array, " *batch"]:
        """Index of the worst status in `STATUS`, one for each run of a batch."""
        # In rising order, so that worse codes overwrite.
        code = jnp.where(jnp.asarray(self.event) >= 0, 1, 0)
        for out in self.outside.values():
            code = jnp.where(jnp.any(out, axis=-1), 2, code)
        # A run that is not finite has also left the range, and the solver may report success.
        code = jnp.where(self.finite, code, 3)
        return jnp.where(self.result == dfx.RESULTS.successful, code, jnp.maximum(code, 4))

    def first(self, n: int) -> "Trajectory":
        """Return the first n samples."""
        # result, finite and status describe the whole run and stay.
        parts = (self.times, self.states, self.outputs, self.inputs, self.outside)
        times, states, outputs, inputs, outside = jax.tree.map(lambda v: v[:n], parts)
        return self._replace(
            times=times, states=states, outputs=outputs, inputs=inputs, outside=outside
        )

    def to_xarray(self) -> "xr.Dataset":
        """Return the run as an xarray Dataset over `time` [s], with states, outputs and inputs by
        name.

        Units are in `attrs["units"]`; runs of a batch are along `run_0`, ... An output or input
        whose name is taken becomes `NAME_output` or `NAME_input`.
        """
        from heli_jax.exports import trajectory_dataset

        return trajectory_dataset(self)
