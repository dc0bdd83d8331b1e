"""What a problem leaves open and its records decide: noise, sizes of gusts, offsets of sticks."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Disturbance, LowPass, Model
from heli_jax.flights.flight import Flight
from heli_jax.numerics.white_noise import rises_when_slower, wanders
from heli_jax.vehicle import of_helicopter

# Outputs whose sensor's noise came through an on-board low-pass, and is not white in the log.


_WHITE_TO = 3.0
"""times its cut-off, up to which rate noise behind a low-pass is nearly white: by simulation, see
docs/onboard.md"""


def filtered_noise(low_passes: Sequence[LowPass], flights: Sequence[Flight]) -> tuple[LowPass, ...]:
    """Those low-passes above whose cut-off the flights have samples, where these bear it out.

    Args:
        low_passes: `Model.low_passes`.
    """
    return tuple(p for p in low_passes if any(_shows(p, f) for f in flights))


def _shows(low_pass: LowPass, flight: Flight) -> bool:
    """Whether noise in an output falls off as the low-pass lets it, near the Nyquist frequency or
    from the least rate at which it is not white."""
    above = 1.0 / (flight.dt * _WHITE_TO * low_pass.hz)
    if low_pass.output not in flight.outputs or not above > 1.0:
        return False
    signal = flight.outputs[low_pass.output]
    # Noise behind the filter, or a coarse log, hides at the fastest end what came through it.
    return wanders(signal) or rises_when_slower(signal, max(2, int(above)))


# How large a disturbance can be: of the size that moves the outputs as far as was measured.


_DEEPEST = 4
"""integrations from a derivative to an output that are looked through: position, flapping, bar"""


def push_scales(
    model: Model,
    params: Any,  # the model's Params, whose class may be a user's own
    inputs: Mapping[str, float],
    outputs: Mapping[str, float],
    disturbances: tuple[Disturbance, ...],
) -> dict[str, float]:
    """By the name of each sigma a standard deviation to begin with, SI.

    A push that lasts for a second reaches an output through C A^k, k integrations away. The scale
    is what would move the most sensitive output as far as it was measured to move.

    Args:
        params: its parameters at the first guess, SI.
        inputs: at the first sample, SI.
        outputs: standard deviation of what was measured, by name, SI.
    """
    at = model.Inputs(**{n: jnp.asarray(v) for n, v in inputs.items()})
    A, _, C, _ = (np.asarray(M) for M in jacobians(model, params, model.initial_state(params), at))
    rows = [naming.names(model.Outputs).index(n) for n in outputs]
    sds, states = np.array(list(outputs.values())), naming.names(model.State)
    # One that no output shows is taken as large as the largest motion, whatever its unit.
    unseen = float(sds.max(initial=0.0)) or 1.0
    return {
        d.sigma: _scale(A, C[rows], sds, states.index(d.state)) if d.state else unseen
        for d in disturbances
    }


def _scale(A: np.ndarray, C: np.ndarray, sds: np.ndarray, state: int) -> float:
    """sd of an output over what a unit push does to it, the least of all outputs; 1 unless seen.

    Args:
        A: (n, n).
        C: (p, n), of the measured outputs.
        sds: (p,), of what was measured.
    """
    reach, least = C, np.inf
    for _ in range(_DEEPEST):
        effect = np.abs(reach[:, state])
        seen = np.isfinite(effect) & (effect > 0) & (sds > 0)
        # The most sensitive output bounds the push: a larger one would have moved it further than
        # was measured.
        least = min(least, float((sds[seen] / effect[seen]).min(initial=np.inf)))
        # The nearest outputs say it best: further on the same motion comes filtered.
        if np.isfinite(least):
            return least
        reach = reach @ A
    return 1.0


# params, states and inputs are Any: records of a model, whose classes may be a user's own.

_EXPLAINED = 1e-6
"""part of an offset's response that initial states and biases leave over where they explain it"""
_ALLOWED = 10.0
"""times what was measured: the sd of the weak prior of a bias or an initial state"""
_HUGE = 1e100
_POINTS = 200
"""samples at which the responses are compared"""


def offset_inputs(
    model: Model, params: Any, flight: Flight, free: tuple[str, ...]
) -> tuple[str, ...]:
    """The sticks of a machine in free flight: those whose constant offset no initial state and no
    bias can take the place of, in the order of the model.

    Throttle and collective have no centre, and where a free parameter is a constant term of the
    equations that parameter stands for the offsets already.

    Args:
        params: its parameters, SI; what is known of the flight replaces them.
    """
    centreless = ("x_throttle", "x_collective", "Omega")
    sticks = [n for n in naming.names(model.Inputs) if n not in centreless]
    # Our model that is not linear is the whole helicopter, which flies free. Its matrices at the
    # mean inputs and the model's own initial state, no trim, would say nothing.
    if of_helicopter(model.Params) and not model.linear:
        return tuple(sticks)
    if flight.known:
        params = naming.replace(params, **{n: jnp.asarray(v) for n, v in flight.known.items()})
    # A model declared linear vanishes at zero, so it has no constant term to look for.
    if not model.linear and _has_constant_term(model, params, free):
        return ()
    unexplained = _unexplained(model, params, flight)
    at = naming.names(model.Inputs)
    # Not '>=': where the comparison has no number an offset is the safer assumption.
    return tuple(n for n in sticks if not unexplained[at.index(n)] < _EXPLAINED)


def _unexplained(model: Model, params: Any, flight: Flight) -> np.ndarray:
    """Of the response to a constant offset of each input (m,) the part that no initial state and no
    constant in the outputs explains, of the model linearised at the flight's mean inputs.

    1 for all of them where the model cannot be linearised there or is unstable over the record, and
    for an input whose offset, as large as its largest excursion, only initial states or constants
    explain that are larger than what was measured.
    """
    response = _responses(model, params, flight)
    n, m = len(naming.names(model.State)), len(naming.names(model.Inputs))
    # Of squares that overflow nothing is known either.
    if not np.max(np.abs(response)) < _HUGE:
        return np.ones(m)
    p = len(flight.outputs)
    constants = np.tile(np.eye(p), (_POINTS + 1, 1))
    others, driven = np.hstack([response[:, :n], constants]), response[:, n:]
    # Columns of one size: a fast decay leaves little of an initial state, and is not nothing.
    sizes = np.linalg.norm(others, axis=0)
    factors: Any = scipy.linalg.qr(
        others / np.where(sizes > 0, sizes, 1.0), mode="economic", pivoting=True
    )
    Q, R = factors[:2]
    # Pivoted, so that dependent columns come last: an angle's initial value is a constant in it.
    kept = np.abs(np.diag(R)) > 1e-10 * np.abs(R[0, 0])
    Q, R = Q[:, kept], R[np.ix_(kept, kept)]
    rest = driven - Q @ (Q.T @ driven)
    size = np.linalg.norm(driven, axis=0)
    # An input that no output shows has no offset to be found.
    left = np.divide(np.linalg.norm(rest, axis=0), size, out=np.zeros(m), where=size > 0)
    # A slow mode (the spiral of an aeroplane) goes far in the end, though not in the record: a
    # constant that stands for its whole way is one that the weak prior of the bias forbids.
    needed = np.abs(scipy.linalg.solve_triangular(R, Q.T @ driven))
    needed *= _excursions(model, flight)
    columns = (others / np.where(sizes > 0, sizes, 1.0))[:, factors[2][kept]]
    measured = np.array([_rms(flight.outputs[n]) for n in sorted(flight.outputs)])
    by_output = columns.reshape(_POINTS + 1, p, -1)
    shown = np.sqrt(np.mean(np.square(by_output), axis=0)) / measured[:, None]
    return np.where(np.max(shown, axis=0) @ needed > _ALLOWED, 1.0, left)


def _excursions(model: Model, flight: Flight) -> np.ndarray:
    """How far each input goes from its mean (m,)."""
    return np.array(
        [
            np.ptp(flight.inputs[n]) / 2.0 if n in flight.inputs else 0.0
            for n in naming.names(model.Inputs)
        ]
    )


def _rms(values: np.ndarray) -> float:
    """Of what was measured; infinite where nothing was."""
    rms = float(np.sqrt(np.nanmean(np.square(values)))) if np.isfinite(values).any() else 0.0
    return rms if rms > 0 else np.inf


def _responses(model: Model, params: Any, flight: Flight) -> np.ndarray:
    """Of the linearised model the outputs over the record ((_POINTS + 1) p, n + m): the free
    response to each initial state, and that to a unit of each input from rest. NaN where there are
    no finite matrices."""
    dtype = jnp.result_type(float)
    inputs = {n: np.asarray(np.mean(flight.inputs[n]), dtype) for n in flight.inputs}
    u = model.Inputs(**{n: inputs[n] for n in naming.names(model.Inputs)})
    space = jacobians(model, params, None, u)
    A, B, C = (np.asarray(M, np.float64) for M in (space.A, space.B, space.C))
    n, m = B.shape
    if not (np.isfinite(A).all() and np.isfinite(B).all() and np.isfinite(C).all()):
        return np.full((1, n + m), np.nan)
    names = naming.names(model.Outputs)
    C = C[[names.index(output) for output in sorted(flight.outputs)]]
    # A constant input is a state that stays: one exponential of [[A, B], [0, 0]] propagates both.
    # D is left out: what an offset adds through it is a constant, which the bias takes up.
    augmented = np.zeros((n + m, n + m))
    augmented[:n, :n], augmented[:n, n:] = A, B
    step = max(flight.duration, flight.dt) / _POINTS
    with np.errstate(all="ignore"):  # an unstable model overflows, which the caller looks at
        E = scipy.linalg.expm(augmented * step)
        rows = np.hstack([C, np.zeros((len(C), m))])
        # By doubling: the responses so far, moved on by their own length, are the next ones.
        while len(rows) < (_POINTS + 1) * len(C):
            rows, E = np.concatenate([rows, rows @ E]), E @ E
        return rows[: (_POINTS + 1) * len(C)]


def _has_constant_term(model: Model, params: Any, free: tuple[str, ...]) -> bool:
    """Whether a free parameter is added to the rates whatever the state and the inputs are."""
    rng = np.random.default_rng(11)
    dtype = jnp.result_type(float)

    def draw(record: type) -> Any:
        names = naming.names(record)
        return record(**{n: jnp.asarray(rng.standard_normal(), dtype) for n in names})

    def rates(values: dict[str, Array], x: Any, u: Any) -> Any:
        return model.vector_field(naming.replace(params, **values), x, u)

    values = {n: jnp.asarray(getattr(params, n), dtype) for n in free}
    slopes_at_points = []
    # A constant term has the same derivative everywhere. Three random points: one where the
    # derivative of another term happens to be the same is as good as impossible.
    for _ in range(3):
        slopes = jax.jacfwd(rates)(values, draw(model.State), draw(model.Inputs))
        by_state = naming.asdict(slopes)
        slopes_at_points.append(np.array([[float(d[n]) for d in by_state.values()] for n in free]))
    for slopes in zip(*slopes_at_points, strict=True):
        first, size = slopes[0], np.max(np.abs(slopes[0]))
        if size > 0 and all(np.max(np.abs(s - first)) <= 1e-9 * size for s in slopes):
            return True
    return False
