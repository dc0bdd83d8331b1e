"""Result of a simulation."""

import functools
from typing import TYPE_CHECKING, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from heli_jax.naming import Record

# The functions of summaries and exports are imported where they are used: they build on this class,
# and pandas, xarray and HTML are no business of a simulation.
if TYPE_CHECKING:
    import xarray as xr

STATUS = ("ok", "ended by an event", "outside the model's range", "not finite", "solver stopped")
"""What `Trajectory.status` counts, from the best to the worst."""


class Trajectory(NamedTuple):
    """A run, sample by sample; batched from outside by vmap."""

    times: Float[Array, " N"]
    """[s], from 0"""
    states: Record
    """the model's State with arrays (N,)"""
    outputs: Record
    """the model's Outputs with arrays (N,)"""
    inputs: Record
    """the model's Inputs with arrays (N,), as they acted at each sample: with the feedback's part,
    and where there are delays, what was commanded that much earlier"""
    result: dfx.RESULTS
    """diffrax's result: `diffrax.RESULTS.successful`, or why the integration stopped"""
    finite: Bool[Array, ""]
    """whether every state is a finite number"""
    outside: dict[str, Bool[Array, " N"]]
    """by name of a limit of the model, where it was left; empty for a model without limits"""
    ended: Float[Array, ""] | float
    """when an event ended the run [s]; inf where none did"""
    event: Int[Array, ""] | int
    """which event that was, in the order given; -1 where none did"""

    @property
    def valid(self) -> Bool[Array, " N"]:
        """True at samples within the model's range that are finite."""
        # Sample by sample: a run that diverges is of use up to where it does.
        finite = [jnp.isfinite(v) for v in jax.tree.leaves(self.states)]
        return functools.reduce(
            jnp.logical_and, [*finite, *(~out for out in self.outside.values())]
        )

    @property
    def status(self) -> Int[Array, " *batch"]:
        """The worst that happened, an index into `STATUS`; one a run of a batch."""
        # From the mildest to the worst, so that what comes later overrules.
        code = jnp.where(jnp.asarray(self.event) >= 0, 1, 0)
        for out in self.outside.values():
            code = jnp.where(jnp.any(out, axis=-1), 2, code)
        # A run that is not finite has left the range as well, and the solver may call it a success.
        code = jnp.where(self.finite, code, 3)
        return jnp.where(self.result == dfx.RESULTS.successful, code, jnp.maximum(code, 4))

    def first(self, n: int) -> "Trajectory":
        """The first n samples of it."""
        # What belongs to the whole run (result, finite, status) stays as it is.
        parts = (self.times, self.states, self.outputs, self.inputs, self.outside)
        times, states, outputs, inputs, outside = jax.tree.map(lambda v: v[:n], parts)
        return self._replace(
            times=times, states=states, outputs=outputs, inputs=inputs, outside=outside
        )

    def __repr__(self) -> str:
        from heli_jax.summaries import as_text, of_trajectory

        return as_text(of_trajectory(self, STATUS))

    def _repr_html_(self) -> str:
        from heli_jax.summaries import as_html, of_trajectory

        return as_html(of_trajectory(self, STATUS))

    def to_xarray(self) -> "xr.Dataset":
        """The run as an xarray Dataset over `time` [s]: states, outputs and inputs by name, each
        with its unit in `attrs["units"]`; runs of a batch along `run_0`, ...

        An output or input of a name that is taken is `NAME_output` or `NAME_input`.
        """
        from heli_jax.exports import trajectory_dataset

        return trajectory_dataset(self)
