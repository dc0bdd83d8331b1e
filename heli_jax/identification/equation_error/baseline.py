"""The paper's way on the same data: RLS, d2c, and from H(s) to a/Ixx and a/If."""

import math
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import get_lapack_funcs

from heli_jax import naming
from heli_jax.analysis.lti import d2c
from heli_jax.dynamics.model import Model, reads
from heli_jax.dynamics.roll import ratios_from_denominator
from heli_jax.flights.flight import Flight
from heli_jax.identification.equation_error.rls import rls, transfer_function
from heli_jax.identification.validation.metrics import NO_METRICS, Metrics, metrics, whiteness
from heli_jax.numbers import terse
from heli_jax.vehicle import of_helicopter

# scipy.linalg.solve_banded knows no triangular case and would factorise; this one only substitutes.
_solve_banded: Any = get_lapack_funcs("tbtrs")

_P0 = 1e12
"""initial variance of every coefficient, of signals scaled to unit rms: nothing is known of it"""
_PER_ORDER = 10
"""samples in a row for each order that a record needs at least"""
_MEANT = 0.05
"""part by which the coefficient of s^2 may miss what the structure of eq. 23 asks for"""
_STARTING = 100
"""first samples, at most, whose errors are those of a P that has not yet fallen"""
_WORSE = 1.5
"""times the error of one step ahead from which on a simulation's error tells of a bias"""


# The parameters of a model are a class of the user's: `Any` here stands for them alone.


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
    """RLS of one flight: its first output (an angle before its rate) from its first input, with the
    first samples, whose past was not recorded, as past alone.

    Args:
        model: names the signals, and says whether physical parameters can be read off.
        params: the vehicle, for its geometry and rotor speed.
        flight: the record.
        order: n of Hd(z); the paper's is 4.
        forgetting: in (0, 1]; a sample j steps ago weighs forgetting^j.

    Raises:
        ValueError: too few samples in a row.
    """
    output = _output(model, flight, _PER_ORDER * order)
    input_ = next(n for n in naming.names(model.Inputs) if n in flight.inputs)
    part = _whole_part(flight, output, order)
    u, y = flight.inputs[input_][part], flight.outputs[output][part]
    history, errors = _scaled_rls(u, y, order, forgetting)
    theta = history[-1]
    num, den = (np.asarray(v) for v in transfer_function(jnp.asarray(theta)))
    poles = np.roots(den)
    simulated = _simulate(num, den, u, y)
    continuous_num, continuous_den, exact, note = _continuous(num, den, flight.dt)
    combinations, doubts = _combinations(model, params, flight, output, continuous_den, order)
    agreement = _metrics(y, simulated)
    sentences = [
        *_instead(model, flight, output),
        *_gaps(flight, output, part),
        *_stability(poles),
        *([note] if note else []),
        *doubts,
        *_bias(errors, y, agreement),
    ]
    return Baseline(
        flight=flight.name or "flight 1",
        output=output,
        input=input_,
        order=order,
        forgetting=forgetting,
        dt=flight.dt,
        theta=theta,
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


def _scaled_rls(
    u: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"], order: int, forgetting: float
) -> tuple[Float[np.ndarray, "N q"], Float[np.ndarray, " k"]]:
    """The history of Theta, and the errors of one step ahead in the unit of y."""
    # To unit rms, so that P(0) means the same whatever the units.
    u_scale, y_scale = _rms(u), _rms(y)
    run = rls(
        jnp.asarray(u / u_scale),
        jnp.asarray(y / y_scale),
        order=order,
        # As arrays: as numbers they would be constants of a program for each value.
        forgetting=jnp.asarray(forgetting),
        p0=jnp.asarray(_P0),
    )
    # Coefficients of past outputs have no unit, those of inputs that of y over u.
    back = np.r_[np.ones(order), np.full(order + 1, y_scale / u_scale)]
    return np.asarray(run.history) * back, np.asarray(run.error)[order:] * y_scale


def _whole_part(flight: Flight, output: str, order: int) -> slice:
    """The samples that RLS can use: it needs every one of its regressor."""
    part = _longest_whole(flight.outputs[output])
    count, least = part.stop - part.start, _PER_ORDER * order
    if count < least:
        raise ValueError(
            f"{output}: expected at least {least} samples in a row for order {order}, got {count}"
        )
    return part


def _longest_whole(y: Float[np.ndarray, " N"]) -> slice:
    """The longest stretch without a missing sample."""
    # A missing sample before the first and after the last: each stretch then has both its ends.
    edges = np.flatnonzero(np.diff(np.concatenate([[True], np.isnan(y), [True]]).astype(int)))
    if not edges.size:
        return slice(0, 0)
    starts, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - starts))
    return slice(int(starts[best]), int(ends[best]))


def _gaps(flight: Flight, output: str, part: slice) -> list[str]:
    y = flight.outputs[output]
    if not np.isnan(y).any():
        return []
    return [
        f"It needs every sample: {int(np.isnan(y).sum())} of {output} are missing, so it saw only "
        f"the {part.stop - part.start} samples from {part.start * flight.dt:.4g} s on."
    ]


def _rms(signal: Float[np.ndarray, " N"]) -> float:
    return float(np.sqrt(np.mean(signal**2))) or 1.0  # a silent signal is left as it is


def _simulate(
    num: Float[np.ndarray, " n"],
    den: Float[np.ndarray, " n"],
    u: Float[np.ndarray, " N"],
    y: Float[np.ndarray, " N"],
) -> Float[np.ndarray, " N"]:
    """Hd driven by the whole input, started from the first measured outputs."""
    n = den.size - 1
    # The whole record and not one step ahead: where sampling is fast any model predicts the next
    # output well, since the last one is nearly the same.
    forced = np.convolve(u, num / den[0])[n : u.size]
    band = np.tile(np.asarray(den / den[0])[:, None], u.size - n)
    past = np.convolve(np.concatenate([y[:n], np.zeros(n)]), den / den[0])[n : 2 * n]
    forced[:n] -= past[: forced.size]
    # den(q) y = num(q) u row by row is a triangular banded system: solved in compiled code, where
    # a recursion in Python would take longer than RLS, and scipy.signal's lfilter imports it all.
    with np.errstate(all="ignore"):  # an unstable Hd overflows, which its sentences say
        rest, _ = _solve_banded(band, forced, uplo="L", diag="U")
    return np.concatenate([y[:n], np.ravel(rest)])


def _output(model: Model, flight: Flight, least: int) -> str:
    """The first output that has `least` samples in a row, else the first."""
    names = _by_preference(model, flight)
    parts = {n: _longest_whole(flight.outputs[n]) for n in names}
    return next((n for n in names if parts[n].stop - parts[n].start >= least), names[0])


def _by_preference(model: Model, flight: Flight) -> list[str]:
    # eq. 23, from which physical parameters are read, is that of an angle.
    present = [n for n in naming.names(model.Outputs) if n in flight.outputs]
    return sorted(present, key=lambda n: naming.unit(model.Outputs, n) != "rad")


def _instead(model: Model, flight: Flight, output: str) -> list[str]:
    """That the output which would be taken is missing too often."""
    first = _by_preference(model, flight)[0]
    if first == output:
        return []
    return [f"It needs samples in a row, which {first} has too few of, so it is of {output}."]


def _metrics(y: Float[np.ndarray, " N"], simulated: Float[np.ndarray, " N"]) -> Metrics:
    # Of a simulation that diverges a metric says nothing.
    if not np.isfinite(simulated).all() or np.abs(simulated).max() > 1e6 * np.abs(y).max():
        return NO_METRICS
    return metrics(y, simulated)


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
    """a/Ixx and a/If where the structure of eq. 23 allows to read them off."""
    if (
        not of_helicopter(model.Params)
        or output not in ("roll", "pitch")
        or len(naming.names(model.State)) != 4
    ):
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
    known = {n: jnp.asarray(v) for n, v in flight.known.items()}  # of this flight alone
    p = naming.replace(params, **known)
    # The vehicle may state a stand that this model does not stand on.
    p = p if reads(model, p, "zeta") else naming.replace(p, zeta=0.0 * p.zeta)
    ratios = ratios_from_denominator(p, den, output)
    # Told even where they are impossible: that the paper's way gives them on this record is what a
    # reader compares with the fit.
    values = {n: float(v) for n, v in ratios.values.items()}
    doubts = []
    wrong = [f"{n} = {terse(v)}" for n, v in values.items() if not (math.isfinite(v) and v > 0)]
    if wrong:
        doubts.append(f"It gives {' and '.join(wrong)}, which no helicopter has.")
    off = float(ratios.p2) / float(ratios.p2_expected) - 1.0
    # p2 is not used for the ratios, so that it can contradict them.
    if abs(off) > _MEANT:
        doubts.append(
            f"Its coefficient of s^2 is {terse(float(ratios.p2))} where its other coefficients and "
            f"the rotor speed ask for {terse(float(ratios.p2_expected))}: it does not have the "
            "structure of eq. 23, and its physical parameters mean little."
        )
    return values, doubts


def _stability(poles: np.ndarray) -> list[str]:
    size = float(np.max(np.abs(poles)))
    if size >= 1.0:
        return [
            f"It has a pole of size {size:.4f}, outside the unit circle: its simulation diverges."
        ]
    return []


def _bias(
    errors: Float[np.ndarray, " k"], y: Float[np.ndarray, " N"], agreement: Metrics
) -> list[str]:
    """Noise biases equation error: coloured errors or a poor simulation show it.

    Args:
        errors: of one step ahead, in the unit of y.
        y: as measured.
        agreement: of the simulation with y.
    """
    sentences = []
    # While P falls from its start the errors are those of no model.
    errors = errors[min(_STARTING, errors.size // 4) :]
    one_step = float(np.sqrt(np.mean(errors**2)))
    if one_step < 1e-8 * float(np.sqrt(np.mean(y**2))):
        return sentences  # no noise at all: what is left is rounding
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
