"""Kim and Tilbury's way (1997): recursive least squares, and from Hd(z) to a/Ixx and a/If.

RLS, eqs 25-33, has Potter's square-root form: P = S S^T is kept as its factor S, so that it stays
symmetric and positive whatever the rounding; the covariance form drifts away within thousands of
samples when old data are forgotten. Functions follow the shape init, step -> (state, info).
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.analysis.lti import d2c
from heli_jax.dynamics.model import Model, reads
from heli_jax.dynamics.roll import ratios_from_denominator
from heli_jax.flights.flight import Flight
from heli_jax.identification.validation.metrics import NO_METRICS, Metrics, metrics, whiteness
from heli_jax.numbers import terse
from heli_jax.vehicle import of_helicopter

_P0 = 1e12
"""initial variance of every coefficient, of signals scaled to unit rms: nothing is known of it"""
_PER_ORDER = 10
"""samples in a row for each order that a record needs at least"""
_MEANT = 0.05
"""part by which the coefficient of s^2 may miss what the structure of eq. 23 asks for"""
_STARTING = 100
"""first samples, at most, whose errors are those of a P that has not yet fallen"""
_WORSE = 1.5
"""times the error of one step ahead from which on a simulation's error shows a bias"""


class RLSState(NamedTuple):
    """What the next step needs."""

    theta: Float[Array, " q"]
    S: Float[Array, "q q"]
    """square root of the covariance matrix: P = S S^T"""


class RLSInfo(NamedTuple):
    """What a step tells."""

    theta: Float[Array, " q"]
    error: Float[Array, ""]
    """y(k) - Phi(k)^T Theta(k-1), eq. 29"""
    largest: Float[Array, ""]
    """largest variance on the diagonal of P"""


class RLSResult(NamedTuple):
    """A whole run."""

    theta: Float[Array, " q"]
    """final estimate"""
    history: Float[Array, "N q"]
    error: Float[Array, " N"]
    largest: Float[Array, " N"]


def rls_init(size: int, p0: float | Float[Array, ""] = 1e6) -> RLSState:
    """Theta(0) = 0 and P(0) = p0 I: a large p0 lets the first samples decide alone."""
    scale = jnp.sqrt(jnp.asarray(p0, jnp.result_type(float)))
    return RLSState(jnp.zeros(size, scale.dtype), scale * jnp.eye(size, dtype=scale.dtype))


def rls_step(
    state: RLSState,
    phi: Float[Array, " q"],
    y: Float[Array, ""],
    forgetting: Float[Array, ""],
    bound: Float[Array, ""],
) -> tuple[RLSState, RLSInfo]:
    """One sample, eqs 29-33 with the gain of eq. 33 (which eq. 31 equals with the new P).

    Args:
        state: Theta (q,) and the square root of P (q, q).
        phi: regressor (q,).
        forgetting: in (0, 1]; a sample j steps ago weighs forgetting^j.
    """
    theta, S = state
    f = jnp.sum(S * phi[:, None], axis=0)
    power = jnp.sum(f * f)
    alpha = forgetting + power
    gain = jnp.sum(S * f[None, :], axis=1) / alpha
    error = y - jnp.sum(phi * theta)
    theta = theta + gain * error
    # Potter's update of the factor: this part of the gain takes S S^T to (1 - gain phi^T) P.
    shrink = 1.0 / (1.0 + jnp.sqrt(forgetting / alpha))
    S = (S - shrink * gain[:, None] * f[None, :]) / jnp.sqrt(forgetting)
    variances = jnp.sum(S * S, axis=1)
    largest = jnp.max(variances)
    # Directions that the regressor does not excite are forgotten without being learnt again, so P
    # grows there without end (wind-up): a variance beyond the bound is taken back to it, as a
    # measurement without news would, which leaves Theta and the excited directions alone.
    S = jax.lax.cond(largest > bound, _bounded, lambda S, *_: S, S, variances, bound)
    return RLSState(theta, S), RLSInfo(theta, error, largest)


def _bounded(
    S: Float[Array, "q q"], variances: Float[Array, " q"], bound: Float[Array, ""]
) -> Float[Array, "q q"]:
    """The largest variance brought down to the bound by a pseudo-measurement of that parameter."""
    i = jnp.argmax(variances)
    f, p = S[i], variances[i]
    # A measurement of variance r leaves p r / (p + r), which is the bound for this r. Both branches
    # of a batched cond are computed: below the bound the divisor must not vanish.
    r = p * bound / jnp.maximum(p - bound, jnp.finfo(S.dtype).tiny)
    alpha = p + r
    gain = jnp.sum(S * f[None, :], axis=1) / alpha
    return S - gain[:, None] * f[None, :] / (1.0 + jnp.sqrt(r / alpha))


def regressors(u: Float[Array, " N"], y: Float[Array, " N"], order: int) -> Float[Array, "N q"]:
    """Return Phi(k) = [y(k-1) ... y(k-n), u(k) ... u(k-n)], eq. 25, (N, 2n + 1), with zeros before
    the first sample.
    """

    def delayed(s: Array, j: int) -> Array:
        return jnp.concatenate([jnp.zeros(j, s.dtype), s[: s.shape[0] - j]])

    past = [delayed(y, j) for j in range(1, order + 1)]
    return jnp.stack(past + [delayed(u, j) for j in range(order + 1)], axis=1)


# As arrays forgetting, p0 and bound share one compiled program; as numbers each value has its own.
@eqx.filter_jit
def rls(
    u: Float[Array, " N"],
    y: Float[Array, " N"],
    *,
    order: int = 4,
    forgetting: float | Float[Array, ""] = 1.0,
    p0: float | Float[Array, ""] = 1e6,
    bound: float | Float[Array, ""] | None = None,
) -> RLSResult:
    """Run RLS over a record: Theta = [-a1 ... -an, b0 ... bn] of Hd(z), eqs 25-33.

    The first n samples have no recorded past: they serve as past only, and the histories hold
    zeros there.

    Args:
        u: input.
        y: output.
        order: n of Hd(z); the paper's is 4.
        forgetting: see `rls_regression`, as p0 and bound.

    Raises:
        ValueError: order below 1, fewer than 2 order + 1 samples, or u and y of unequal length.
    """
    if order < 1:
        raise ValueError(f"order must be at least 1, got {order}")
    if u.shape != y.shape or u.ndim != 1:
        raise ValueError(f"u and y: expected shape (N,) for both, got {u.shape} and {y.shape}")
    if u.shape[0] < 2 * order + 1:
        raise ValueError(
            f"expected at least {2 * order + 1} samples for order {order}, got {u.shape[0]}"
        )
    phi = regressors(u, y, order)
    # Zeros in place of an unrecorded past would be learnt as if the helicopter had rested.
    run = rls_regression(phi[order:], y[order:], forgetting, p0, bound)

    def padded(values: Array) -> Array:
        return jnp.concatenate([jnp.zeros((order, *values.shape[1:]), values.dtype), values])

    return RLSResult(run.theta, padded(run.history), padded(run.error), padded(run.largest))


def rls_regression(
    phi: Float[Array, "N q"],
    y: Float[Array, " N"],
    forgetting: float | Float[Array, ""] = 1.0,
    p0: float | Float[Array, ""] = 1e6,
    bound: float | Float[Array, ""] | None = None,
) -> RLSResult:
    """Run RLS with any regressors: y(k) = phi(k)^T theta.

    Args:
        forgetting: in (0, 1].
        bound: largest variance that P may reach, against wind-up; 100 p0 unless given.
    """
    dtype = phi.dtype
    p0 = jnp.asarray(p0, dtype)
    factor = jnp.asarray(forgetting, dtype)
    # Far enough above p0 to leave estimates alone; without a bound P would overflow.
    limit = jnp.asarray(100.0 * p0 if bound is None else bound, dtype)

    def step(state: RLSState, sample: tuple[Array, Array]) -> tuple[RLSState, RLSInfo]:
        return rls_step(state, *sample, factor, limit)

    initial = rls_init(phi.shape[1], p0)
    # A scan keeps the types of what it carries: float32 records stay so beside a float64 p0.
    initial = jax.tree.map(lambda v: v.astype(dtype), initial)
    state, info = jax.lax.scan(step, initial, (phi, y))
    return RLSResult(state.theta, info.theta, info.error, info.largest)


def transfer_function(
    theta: Float[Array, " q"],
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Return num and den (n + 1,) of Hd(z), highest power first, from Theta (2n + 1,), eqs 24 and
    26."""
    n = (theta.shape[0] - 1) // 2
    # Theta holds -a: eq. 25 has the past outputs on the side of the inputs.
    return theta[n:], jnp.concatenate([jnp.ones(1, theta.dtype), -theta[:n]])


@dataclass(frozen=True, eq=False)
class Baseline:
    """RLS on one input and one output of one flight, and what can be read from it."""

    flight: str
    output: str
    input: str
    order: int
    forgetting: float
    dt: float
    theta: np.ndarray
    """(2n + 1,) final [-a1 ... -an, b0 ... bn]"""
    num: np.ndarray
    den: np.ndarray
    """of Hd(z), highest power first"""
    poles: np.ndarray
    history: np.ndarray
    """(N, 2n + 1)"""
    continuous_num: np.ndarray | None
    continuous_den: np.ndarray | None
    exact: bool
    """whether the continuous form gives Hd back when it is sampled"""
    note: str
    combinations: dict[str, float]
    times: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    metrics: Metrics
    trusted: bool
    sentences: tuple[str, ...]


def baseline(
    model: Model, params: Any, flight: Flight, *, order: int = 4, forgetting: float = 1.0
) -> Baseline:
    """Return RLS of one flight: its first output (an angle before its rate) from its first input.

    Args:
        model: names the signals, and shows whether physical parameters can be read off.
        params: the model's Params, for the vehicle's geometry and rotor speed.
        order: n of Hd(z); the paper's is 4.
        forgetting: in (0, 1]; a sample j steps ago weighs forgetting^j.

    Raises:
        ValueError: too few samples in a row.
    """
    output, part, sentences = _samples(model, flight, _PER_ORDER * order)
    if part.stop - part.start < _PER_ORDER * order:
        raise ValueError(
            f"{output}: expected at least {_PER_ORDER * order} samples in a row for order {order}, "
            f"got {part.stop - part.start}"
        )
    input_ = next(n for n in naming.names(model.Inputs) if n in flight.inputs)
    u, y = flight.inputs[input_][part], flight.outputs[output][part]
    # To unit rms, so that P(0) means the same whatever the units; a silent signal is left as it is.
    u_scale, y_scale = (float(np.sqrt(np.mean(v**2))) or 1.0 for v in (u, y))
    # Numbers as arrays: otherwise they would be constants of a program for each value.
    run = rls(
        jnp.asarray(u / u_scale),
        jnp.asarray(y / y_scale),
        order=order,
        forgetting=jnp.asarray(forgetting),
        p0=jnp.asarray(_P0),
    )
    # Coefficients of past outputs have no unit, those of inputs that of y over u.
    back = np.r_[np.ones(order), np.full(order + 1, y_scale / u_scale)]
    history, errors = np.asarray(run.history) * back, np.asarray(run.error)[order:] * y_scale
    num, den = (np.asarray(v) for v in transfer_function(jnp.asarray(history[-1])))
    poles = np.roots(den)
    simulated = _simulate(num, den, u, y)
    diverges = not np.abs(simulated).max() <= 1e6 * np.abs(y).max()
    agreement = NO_METRICS if diverges else metrics(y, simulated)
    continuous_num, continuous_den, exact, note = _continuous(num, den, flight.dt)
    combinations, doubts = _combinations(model, params, flight, output, continuous_den, order)
    if (size := float(np.max(np.abs(poles)))) >= 1.0:
        sentences.append(
            f"It has a pole of size {size:.4f}, outside the unit circle: its simulation diverges."
        )
    sentences += [*([note] if note else []), *doubts, *_bias(errors, y, agreement)]
    return Baseline(
        flight=flight.name or "flight 1",
        output=output,
        input=input_,
        order=order,
        forgetting=forgetting,
        dt=flight.dt,
        theta=history[-1],
        num=num,
        den=den,
        poles=poles,
        history=history,
        continuous_num=continuous_num,
        continuous_den=continuous_den,
        exact=exact,
        note=note,
        combinations=combinations,
        times=flight.times[part],
        measured=y,
        simulated=simulated,
        metrics=agreement,
        trusted=not sentences,
        sentences=tuple(sentences),
    )


def _samples(model: Model, flight: Flight, least: int) -> tuple[str, slice, list[str]]:
    """The first output with `least` samples in a row (else the first), its longest part without a
    missing sample, and what is to be said of both."""
    # An angle before its rate: eq. 23, which physical parameters are read from, is of an angle.
    names = [n for n in naming.names(model.Outputs) if n in flight.outputs]
    names = sorted(names, key=lambda n: naming.unit(model.Outputs, n) != "rad")
    parts = {}
    for name in names:
        missing = np.r_[True, np.isnan(flight.outputs[name]), True]
        edges = np.flatnonzero(np.diff(missing.astype(int))).reshape(-1, 2)
        parts[name] = slice(*max(edges.tolist(), key=lambda e: e[1] - e[0], default=(0, 0)))
    output = next((n for n in names if parts[n].stop - parts[n].start >= least), names[0])
    part, missing = parts[output], int(np.isnan(flight.outputs[output]).sum())
    sentences = []
    if output != names[0]:
        sentences.append(
            f"It needs samples in a row, which {names[0]} has too few of, so it is of {output}."
        )
    if missing:
        sentences.append(
            f"It needs every sample: {missing} of {output} are missing, so it saw only the "
            f"{part.stop - part.start} samples from {part.start * flight.dt:.4g} s on."
        )
    return output, part, sentences


def _simulate(
    num: Float[np.ndarray, " n"],
    den: Float[np.ndarray, " n"],
    u: Float[np.ndarray, " N"],
    y: Float[np.ndarray, " N"],
) -> Float[np.ndarray, " N"]:
    """Hd driven by the whole input, started from the first measured outputs."""
    # The whole record and not one step ahead: where sampling is fast any model predicts the next
    # output well, since the last one is nearly the same.
    n, simulated = den.size - 1, y.copy()
    with np.errstate(all="ignore"):  # an unstable Hd overflows
        forced = np.convolve(u, num / den[0])
        # A loop: importing scipy.signal takes longer than all of it.
        for k in range(n, y.size):
            simulated[k] = forced[k] - den[1:] @ simulated[k - n : k][::-1] / den[0]
    return simulated


def _continuous(
    num: np.ndarray, den: np.ndarray, dt: float
) -> tuple[np.ndarray | None, np.ndarray | None, bool, str]:
    """H(s), whether it is the inverse of the zero-order hold, and why not."""
    try:
        return *d2c(num, den, dt, "zoh"), True, ""
    except ValueError as e:
        # Only what is wrong: the remedy behind the semicolon is what follows here.
        refused = str(e).split(";")[0]
    try:
        continuous = d2c(num, den, dt, "real-log")
    except ValueError as e:
        return None, None, False, f"It has no continuous form: {e}."
    return (
        *continuous,
        False,
        f"Its continuous form is the real part of a matrix logarithm, which is another system: "
        f"{refused}.",
    )


def _combinations(
    model: Model, params: Any, flight: Flight, output: str, den: np.ndarray | None, order: int
) -> tuple[dict[str, float], list[str]]:
    """a/Ixx and a/If where the structure of eq. 23 allows to read them off, and doubts."""
    angle = output in ("roll", "pitch")
    if not (angle and of_helicopter(model.Params) and len(naming.names(model.State)) == 4):
        return {}, [
            "Physical parameters cannot be computed from its coefficients for this model and "
            f"output ({output})."
        ]
    if den is None:
        return {}, []
    if order != 4:
        return {}, [
            f"Order {order} is not the fourth order of eq. 23: no physical parameters "
            "can be read from it."
        ]
    p = naming.replace(params, **{n: jnp.asarray(v) for n, v in flight.known.items()})
    # The vehicle may state a stand that this model does not stand on.
    p = p if reads(model, p, "zeta") else naming.replace(p, zeta=0.0 * p.zeta)
    ratios = ratios_from_denominator(p, den, output)
    values, doubts = {n: float(v) for n, v in ratios.values.items()}, []
    wrong = [f"{n} = {terse(v)}" for n, v in values.items() if not (math.isfinite(v) and v > 0)]
    if wrong:
        doubts.append(f"It gives {' and '.join(wrong)}, which no helicopter has.")
    # The ratios do not use p2, so that it can contradict them.
    p2, expected = float(ratios.p2), float(ratios.p2_expected)
    if abs(p2 / expected - 1.0) > _MEANT:
        doubts.append(
            f"Its coefficient of s^2 is {terse(p2)} where its other coefficients and the rotor "
            f"speed ask for {terse(expected)}: it does not have the structure of eq. 23, and its "
            "physical parameters mean little."
        )
    return values, doubts


def _bias(
    errors: Float[np.ndarray, " k"], y: Float[np.ndarray, " N"], agreement: Metrics
) -> list[str]:
    """What shows that noise biases least squares on past measured outputs."""
    # While P falls from its start the errors are those of no model.
    errors = errors[min(_STARTING, errors.size // 4) :]
    one_step = float(np.sqrt(np.mean(errors**2)))
    if one_step < 1e-8 * float(np.sqrt(np.mean(y**2))):
        return []  # no noise: the rest is rounding
    sentences = []
    if math.isnan(agreement.rmse):
        sentences.append("Its simulation diverges from the measured output; no metrics are given.")
    # Without a bias both errors are the same noise; past outputs in the regressor hide it from the
    # error of one step, not from the simulation.
    elif agreement.rmse > _WORSE * one_step:
        sentences.append(
            f"Its rms error is {terse(one_step, 2)} one sample ahead but "
            f"{terse(agreement.rmse, 2)} in simulation: least squares on past measured outputs is "
            "biased by their noise."
        )
    if not whiteness(errors).white:
        sentences.append(
            "Its one-step errors are not white: noise on the measured output or disturbances bias "
            "its coefficients."
        )
    return sentences
