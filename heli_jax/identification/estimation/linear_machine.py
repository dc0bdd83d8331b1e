"""A flight's linear machine in discrete time: matrices, and simulation.

The one place from which the fit of responses takes them: a model that is linearised at a flight's
trim need only be put in here.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import StateSpace, jacobians
from heli_jax.identification.estimation.simulated_flights import driven
from heli_jax.identification.unknowns.layout import Data, Layout, Unknowns
from heli_jax.simulation.blocks import blockwise
from heli_jax.simulation.discretize import Discrete
from heli_jax.simulation.hold import between_samples
from heli_jax.simulation.solvers import ZeroOrderHoldArgs
from heli_jax.simulation.stepping import held_columns, start_state

_LAGS = 48
"""lags, from a sample to the record's length, at which an impulse response is looked at"""


class Machine(NamedTuple):
    """x[k+1] = Ad x[k] + B U[k], y[k] = C x[k] + D acting[k]; n states, p measured outputs."""

    Ad: Float[Array, "n n"]
    B: Float[Array, "n r"]
    U: Float[Array, "N r"]
    """inputs now, late ones, and next ones"""
    acting: Float[Array, "N m"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]
    x0: Float[Array, " n"]

    def simulated(self, block: int) -> Float[Array, "p N"]:
        """The outputs from the first sample on.

        Args:
            block: samples in a step of the recurrence.
        """
        dt = jnp.ones((), self.Ad.dtype)
        args = ZeroOrderHoldArgs(None, tuple(self.U.T), dt, None, Discrete(self.Ad, self.B, None))
        states = jnp.stack(blockwise(args, block, tuple(self.x0)))
        return self.C @ states + self.D @ self.acting.T


def machine_of(layout: Layout, data: Data, u: Unknowns, i: int) -> Machine:
    """The i-th flight's, with the outputs that it measures.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        u: the unknowns.
        i: the flight's number.
    """
    model, drive = layout.model, driven(layout, data, u, i)
    model, inputs, linear = between_samples(model, drive.inputs, drive.inputs, layout.hold(i))
    Ad, B, U, acting = held_columns(model, drive.params, inputs, drive.dt, u.shift, linear)
    _, _, C, D = jacobians(model, drive.params)
    rows = np.asarray([naming.names(model.Outputs).index(n) for n in layout.outputs[i]])
    x0 = start_state(model, drive.params, drive.state, drive.inputs)
    return Machine(Ad, B, U, acting, C[rows], D[rows], naming.ravel(x0, Ad.dtype))


def forgets(
    matrices: StateSpace, dt: float, sizes: Float[np.ndarray, " m"], length: int, samples: int
) -> Bool[np.ndarray, " p"]:
    """Of each output whether what an input did has decayed to a part of e after a window, and stays
    so over the record: then a simulation of the whole record is sound.

    Args:
        matrices: of the model, with numbers.
        dt: [s].
        sizes: standard deviation of each input.
        length: samples of a window.
        samples: of the record.
    """
    A, B, C = (np.asarray(v, float) for v in matrices[:3])
    if not all(np.isfinite(v).all() for v in (A, B, C)):
        return np.zeros(C.shape[0], bool)
    Ad = scipy.linalg.expm(A * dt)
    lags = np.geomspace(1, max(samples, 2 * length), _LAGS).astype(int)
    lags = np.unique(np.append(lags, length))
    with np.errstate(all="ignore"):
        powers = [np.linalg.matrix_power(Ad, int(t)) for t in lags]
        g = np.array([np.linalg.norm(C @ P @ (B * sizes), axis=1) for P in powers])
        peak = np.max(g[lags <= length], axis=0)
        return np.all(g[lags >= length] <= np.exp(-1.0) * peak, axis=0)
