"""Defaults that depend on the records: filtered noise and offsets of sticks."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import LowPass, Model
from heli_jax.flights.flight import Flight
from heli_jax.numerics.white_noise import has_coloured_noise, rises_when_slower
from heli_jax.vehicle import of_helicopter

_WHITE_TO = 3.0
"""Sampling rate up to which low-passed noise is nearly white, as a multiple of the cut-off (by
simulation, see docs/onboard.md)."""


def filtered_noise(low_passes: Sequence[LowPass], flights: Sequence[Flight]) -> tuple[LowPass, ...]:
    """Return the low-passes that are visible in the noise of the flights."""
    return tuple(p for p in low_passes if any(_shows(p, f) for f in flights))


def _shows(low_pass: LowPass, flight: Flight) -> bool:
    """True if the noise of an output falls off as behind the low-pass."""
    above = 1.0 / (flight.dt * _WHITE_TO * low_pass.hz)
    if low_pass.output not in flight.outputs or not above > 1.0:
        return False
    signal = flight.outputs[low_pass.output]
    # Noise added behind the filter, or coarse resolution, hides the fall near the Nyquist
    # frequency.
    return has_coloured_noise(signal) or rises_when_slower(signal, max(2, int(above)))


# Params, states and inputs are Any, because each model has its own records.

_ALLOWED = 10.0
"""Standard deviation of the weak prior of a bias or initial state, as a multiple of the measured
size."""
_ROUNDING = 1e-8


def offset_inputs(
    model: Model, params: Any, flight: Flight, free: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the sticks of a vehicle in free flight that have an offset.

    The offset differs from an initial state or bias. The order is that of the model. Throttle and
    collective have no centre. A free constant term in the equations replaces all offsets.
    """
    if model.sampled is not None:
        return ()  # the controller counteracts an offset
    centreless = ("x_throttle", "x_collective", "Omega")
    sticks = [n for n in naming.names(model.Inputs) if n not in centreless]
    # The nonlinear model is the complete helicopter, which flies freely.
    if of_helicopter(model.Params) and not model.linear:
        return tuple(sticks)
    if flight.known:
        params = naming.replace(params, **{n: jnp.asarray(v) for n, v in flight.known.items()})
    # A model declared linear has no constant term.
    if not model.linear and _has_constant_term(model, params, free):
        return ()
    taken_up = _taken_up(model, params, flight)
    return tuple(n for n in sticks if n not in taken_up)


def _taken_up(model: Model, params: Any, flight: Flight) -> set[str]:
    """Return the inputs whose constant offset only moves the equilibrium, like a bias.

    A vehicle in free flight has no such equilibrium, or one beyond the weak prior of a bias. A slow
    mode (an aeroplane's spiral) moves far in the end, but not within the record. The model is
    linearised at the flight's mean inputs.
    """
    dtype = jnp.result_type(float)
    means = {n: np.asarray(np.mean(u), dtype) for n, u in flight.inputs.items()}
    inputs, outputs = naming.names(model.Inputs), naming.names(model.Outputs)
    space = jacobians(model, params, None, model.Inputs(**{n: means[n] for n in inputs}))
    A, B, C = (np.asarray(M, np.float64) for M in (space.A, space.B, space.C))
    if not (np.isfinite(A).all() and np.isfinite(B).all() and np.isfinite(C).all()):
        return set()
    C = C[[outputs.index(n) for n in flight.outputs]]
    A, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    B, C = B / scale[:, None], C * scale
    # Only the observable part must come to rest: the span of C', A'C', ...
    V, further = np.zeros((len(A), 0)), C.T
    while further.size:
        sizes = np.max(np.abs(further), axis=0)
        further = further[:, sizes > 0] / sizes[sizes > 0]
        left = further - V @ (V.T @ further)
        U, s, _ = np.linalg.svd(left - V @ (V.T @ left), full_matrices=False)
        further = U[:, s > _ROUNDING]
        V, further = np.hstack([V, further]), A.T @ further
    rates, drive = V.T @ A @ V, V.T @ B
    x = np.linalg.lstsq(rates, -drive, rcond=_ROUNDING)[0]
    largest = np.array([np.ptp(flight.inputs[n]) / 2.0 for n in inputs])
    rms = np.array([np.sqrt(np.nanmean(np.square(y))) for y in flight.outputs.values()])
    # Squares of large start values may overflow.
    with np.errstate(all="ignore"):
        rests = np.linalg.norm(rates @ x + drive, axis=0) <= 1e-6 * np.linalg.norm(drive, axis=0)
        # With another initial state the offset is in equilibrium from the first sample on, unless
        # an unstable mode diverges within the record.
        end = C @ V @ scipy.linalg.expm(rates * flight.duration) @ x
        moved = np.stack([C @ V @ x, end])
        near = np.all(np.abs(moved) * largest <= _ALLOWED * rms[:, None], axis=(0, 1))
    return {n for n, taken in zip(inputs, rests & near, strict=True) if taken}


def _has_constant_term(model: Model, params: Any, free: tuple[str, ...]) -> bool:
    """True if a free parameter is a constant term of the rates."""
    rng = np.random.default_rng(11)
    dtype = jnp.result_type(float)

    def draw(record: type) -> Any:
        names = naming.names(record)
        return record(**{n: jnp.asarray(rng.standard_normal(), dtype) for n in names})

    def rates(values: dict[str, Array], x: Any, u: Any) -> Any:
        return model.vector_field(naming.replace(params, **values), x, u)

    values = {n: jnp.asarray(getattr(params, n), dtype) for n in free}
    slopes_at_points = []
    # A constant term has the same derivative everywhere; three random points suffice.
    for _ in range(3):
        slopes = jax.jacfwd(rates)(values, draw(model.State), draw(model.Inputs))
        by_state = naming.asdict(slopes)
        slopes_at_points.append(np.array([[float(d[n]) for d in by_state.values()] for n in free]))
    for slopes in zip(*slopes_at_points, strict=True):
        first, size = slopes[0], np.max(np.abs(slopes[0]))
        if size > 0 and all(np.max(np.abs(s - first)) <= 1e-9 * size for s in slopes):
            return True
    return False
