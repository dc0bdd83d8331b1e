"""Recursive least squares (Kim and Tilbury, 1997), and a/Ixx and a/If from Hd(z).

RLS, eqs 25-33, uses Potter's square-root form: P = S S^T is stored as its factor S, which keeps P
symmetric and positive definite. With forgetting, the covariance form loses this within thousands of
samples.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.analysis.lti import d2c
from heli_jax.dynamics.model import Model, reads
from heli_jax.dynamics.roll import ratios_from_denominator
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.validation.metrics import NO_METRICS, Metrics, metrics, whiteness
from heli_jax.numbers import terse
from heli_jax.vehicle import of_helicopter

_P0 = 1e12
"""Initial variance of every coefficient, for signals of unit rms."""
_PER_ORDER = 10
"""Fewest consecutive samples for each order."""
_MEANT = 0.05
"""Largest relative error of the coefficient of s^2 under the structure of eq. 23."""
_STARTING = 100
"""Most initial samples that are excluded from the one-step errors."""


class RLSState(NamedTuple):
    """Estimate after a sample."""

    theta: Float[Array, " q"]
    S: Float[Array, "q q"]
    """Square root of the covariance matrix: P = S S^T."""


class RLSInfo(NamedTuple):
    """Results of a step."""

    error: Float[Array, ""]
    """Prediction error y(k) - Phi(k)^T Theta(k-1), eq. 29."""
    largest: Float[Array, ""]
    """Largest variance on the diagonal of P."""


class RLSResult(NamedTuple):
    """RLS over a record."""

    theta: Float[Array, " q"]
    """Final estimate."""
    history: Float[Array, "N q"]
    error: Float[Array, " N"]
    largest: Float[Array, " N"]


def rls_init(size: int, p0: float | Float[Array, ""] = 1e6) -> RLSState:
    """Return Theta(0) = 0 and P(0) = p0 I; with a large p0 the first samples alone decide."""
    scale = jnp.sqrt(jnp.asarray(p0))
    return RLSState(jnp.zeros(size, scale.dtype), scale * jnp.eye(size, dtype=scale.dtype))


def rls_step(
    state: RLSState,
    phi: Float[Array, " q"],
    y: Float[Array, ""],
    forgetting: Float[Array, ""],
    bound: Float[Array, ""],
) -> tuple[RLSState, RLSInfo]:
    """Update the estimate by one sample: eqs 29-33 with the gain of eq. 33.

    Eq. 31 with the new P gives the same gain. A sample j steps ago has the weight forgetting^j.
    """
    theta, S = state
    f = jnp.sum(S * phi[:, None], axis=0)
    alpha = forgetting + jnp.sum(f * f)
    gain = jnp.sum(S * f[None, :], axis=1) / alpha
    error = y - jnp.sum(phi * theta)
    theta = theta + gain * error
    # Potter's update: this factor of the gain turns S S^T into (1 - gain phi^T) P.
    shrink = 1.0 / (1.0 + jnp.sqrt(forgetting / alpha))
    S = (S - shrink * gain[:, None] * f[None, :]) / jnp.sqrt(forgetting)
    variances = jnp.sum(S * S, axis=1)
    largest = jnp.max(variances)
    # The bound prevents wind-up: with forgetting, P grows without limit in directions without
    # excitation.
    S = jax.lax.cond(largest > bound, _bounded, lambda S, *_: S, S, variances, bound)
    return RLSState(theta, S), RLSInfo(error, largest)


def _bounded(
    S: Float[Array, "q q"], variances: Float[Array, " q"], bound: Float[Array, ""]
) -> Float[Array, "q q"]:
    """Reduce the largest variance to the bound by a pseudo-measurement of that parameter.

    Theta and the excited directions do not change.
    """
    i = jnp.argmax(variances)
    f, p = S[i], variances[i]
    # A measurement of variance r leaves the variance p r / (p + r). A batched cond computes both
    # branches, so the divisor must not vanish below the bound.
    r = p * bound / jnp.maximum(p - bound, jnp.finfo(S.dtype).tiny)
    alpha = p + r
    gain = jnp.sum(S * f[None, :], axis=1) / alpha
    return S - gain[:, None] * f[None, :] / (1.0 + jnp.sqrt(r / alpha))


def regressors(u: Float[Array, " N"], y: Float[Array, " N"], order: int) -> Float[Array, "N q"]:
    """Return Phi(k) = [y(k-1) ... y(k-n), u(k) ... u(k-n)], eq. 25, (N, 2n + 1), with zeros before
    the first sample."""
    lags = [(y, j) for j in range(1, order + 1)] + [(u, j) for j in range(order + 1)]
    return jnp.stack([jnp.pad(s, (j, 0))[: s.shape[0]] for s, j in lags], axis=1)


# Arrays of forgetting, p0 and bound share one compiled program; each number would have its own.
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

    The first n samples lack a recorded past. They serve only as past, and the histories are zero
    there.

    Args:
        order: n of Hd(z); 4 in the paper.
        forgetting: see `rls_regression`, also for p0 and bound.

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
    theta, *run = rls_regression(phi[order:], y[order:], forgetting, p0, bound)
    return RLSResult(
        theta, *(jnp.zeros((u.size, *v.shape[1:]), v.dtype).at[order:].set(v) for v in run)
    )


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
        bound: largest variance in P, against wind-up; default 100 p0.
    """
    # A scan carries one dtype, that of the records.
    p0, factor = jnp.asarray(p0, phi.dtype), jnp.asarray(forgetting, phi.dtype)
    limit = jnp.asarray(100.0 * p0 if bound is None else bound, phi.dtype)

    def step(state: RLSState, sample: tuple[Array, Array]) -> tuple[RLSState, tuple[Array, ...]]:
        state, info = rls_step(state, *sample, factor, limit)
        return state, (state.theta, *info)

    state, run = jax.lax.scan(step, rls_init(phi.shape[1], p0), (phi, y))
    return RLSResult(state.theta, *run)


def transfer_function(theta: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return num and den (n + 1,) of Hd(z) from Theta (2n + 1,), eqs 24 and 26.

    The highest power comes first.
    """
    theta = np.asarray(theta)
    n = theta.size // 2
    # Theta holds -a (eq. 25).
    return theta[n:], np.r_[1.0, -theta[:n]]


@dataclass(frozen=True, eq=False)
class Baseline:
    """RLS on one input and one output of one flight, and its physical parameters."""

    flight: str
    output: str
    input: str
    order: int
    forgetting: float
    dt: float
    history: np.ndarray
    """[-a1 ... -an, b0 ... bn] after each sample, (N, 2n + 1)."""
    continuous_num: np.ndarray | None
    continuous_den: np.ndarray | None
    note: str
    """Reason why the continuous form is not the inverse of the hold; empty if it is."""
    combinations: dict[str, float]
    simulated: np.ndarray
    """Simulation of Hd over the whole record, from its first measured outputs."""
    metrics: Metrics
    """Metrics of the simulation."""
    findings: tuple[Finding, ...]
    """Doubts about the estimates."""

    @property
    def theta(self) -> np.ndarray:
        """Final coefficients (2n + 1,)."""
        return self.history[-1]

    @property
    def num(self) -> np.ndarray:
        """Numerator of Hd(z), highest power first."""
        return transfer_function(self.theta)[0]

    @property
    def den(self) -> np.ndarray:
        """Denominator of Hd(z), highest power first."""
        return transfer_function(self.theta)[1]

    @property
    def poles(self) -> np.ndarray:
        """Poles of Hd(z)."""
        return np.roots(self.den)

    @property
    def exact(self) -> bool:
        """True if the continuous form is the inverse of the zero-order hold."""
        return not self.note

    @property
    def trusted(self) -> bool:
        """True if there is no doubt."""
        return not self.findings

    @property
    def sentences(self) -> list[str]:
        """Sentences of the findings."""
        return [f.sentence for f in self.findings]


def baseline(
    model: Model, params: Any, flight: Flight, *, order: int = 4, forgetting: float = 1.0
) -> Baseline:
    """Return RLS of one flight: its first output (an angle before its rate) from its first input.

    Args:
        params: the model's Params, for the vehicle's geometry and rotor speed.
        order: n of Hd(z); 4 in the paper.
        forgetting: in (0, 1]; a sample j steps ago has the weight forgetting^j.

    Raises:
        ValueError: too few consecutive samples.
    """
    output, part, findings = _samples(model, flight, _PER_ORDER * order)
    if part.stop - part.start < _PER_ORDER * order:
        raise ValueError(
            f"{output}: expected at least {_PER_ORDER * order} samples in a row for order {order}, "
            f"got {part.stop - part.start}"
        )
    input_ = next(n for n in naming.names(model.Inputs) if n in flight.inputs)
    u, y = flight.inputs[input_][part], flight.outputs[output][part]
    # P(0) assumes signals of unit rms.
    u_scale, y_scale = (float(np.sqrt(np.mean(v**2))) or 1.0 for v in (u, y))
    run = rls(
        jnp.asarray(u / u_scale),
        jnp.asarray(y / y_scale),
        order=order,
        forgetting=jnp.asarray(forgetting),
        p0=jnp.asarray(_P0),
    )
    back = np.r_[np.ones(order), np.full(order + 1, y_scale / u_scale)]
    history = np.asarray(run.history) * back
    num, den = transfer_function(history[-1])
    from scipy.signal import lfilter, lfiltic

    # Simulation from the first measured outputs is the harder test: any model predicts one step
    # well.
    begun = lfiltic(num, den, y[order - 1 :: -1], u[order - 1 :: -1])
    simulated = np.r_[y[:order], lfilter(num, den, u[order:], zi=begun)[0]]
    diverges = not np.abs(simulated).max() <= 1e6 * np.abs(y).max()
    agreement = NO_METRICS if diverges else metrics(y, simulated)
    if (size := float(np.max(np.abs(np.roots(den))))) >= 1.0:
        findings.append(found("rls.unstable", value=size))
    (continuous_num, continuous_den), not_exact = _continuous(num, den, flight.dt)
    combinations, doubts = _combinations(model, params, flight, output, continuous_den, order)
    errors = np.asarray(run.error)[order:] * y_scale
    return Baseline(
        flight=flight.name or "flight 1",
        output=output,
        input=input_,
        order=order,
        forgetting=forgetting,
        dt=flight.dt,
        history=history,
        continuous_num=continuous_num,
        continuous_den=continuous_den,
        note=not_exact[0].sentence if not_exact else "",
        combinations=combinations,
        simulated=simulated,
        metrics=agreement,
        findings=(*findings, *not_exact, *doubts, *_bias(errors, y)),
    )


def _samples(model: Model, flight: Flight, least: int) -> tuple[str, slice, list[Finding]]:
    """Return the first output with `least` consecutive samples (else the first output), and its
    longest part without a gap."""
    # An angle comes before its rate because eq. 23 describes an angle.
    names = [n for n in naming.names(model.Outputs) if n in flight.outputs]
    names = sorted(names, key=lambda n: naming.unit(model.Outputs, n) != "rad")
    parts = {}
    for name in names:
        seen = ~np.isnan(flight.outputs[name])
        clumps = np.ma.clump_masked(np.ma.array(seen, mask=seen))
        parts[name] = max(clumps, key=lambda s: s.stop - s.start, default=slice(0, 0))
    output = next((n for n in names if parts[n].stop - parts[n].start >= least), names[0])
    part, missing = parts[output], int(np.isnan(flight.outputs[output]).sum())
    findings = []
    if output != names[0]:
        findings.append(found("rls.other-output", "doubt", output, instead=names[0]))
    if missing:
        samples, begin = part.stop - part.start, part.start * flight.dt
        findings.append(
            found("rls.part", "doubt", output, value=float(missing), samples=samples, begin=begin)
        )
    return output, part, findings


type _Polynomials = tuple[np.ndarray | None, np.ndarray | None]


def _continuous(num: np.ndarray, den: np.ndarray, dt: float) -> tuple[_Polynomials, list[Finding]]:
    """Return H(s), and the reason if it is not the inverse of the zero-order hold."""
    try:
        return d2c(num, den, dt, "zoh"), []
    except ValueError as e:
        # The remedy after the semicolon does not apply here.
        refused = str(e).split(";")[0]
    try:
        return d2c(num, den, dt, "real-log"), [found("rls.real-logarithm", reason=refused)]
    except ValueError as e:
        return (None, None), [found("rls.no-continuous-form", reason=str(e))]


def _combinations(
    model: Model, params: Any, flight: Flight, output: str, den: np.ndarray | None, order: int
) -> tuple[dict[str, float], list[Finding]]:
    """Return a/Ixx and a/If if the model has the structure of eq. 23, and doubts."""
    fourth_order = len(naming.names(model.State)) == 4
    known = output in ("roll", "pitch") and of_helicopter(model.Params) and fourth_order
    if not known or order != 4:
        return {}, [found("rls.no-parameters", "doubt", output, value=float(order))]
    if den is None:
        return {}, []
    p = naming.replace(params, **{n: jnp.asarray(v) for n, v in flight.known.items()})
    # The model has no stand.
    p = p if reads(model, p, "zeta") else naming.replace(p, zeta=0.0 * p.zeta)
    ratios = ratios_from_denominator(p, den, output)
    values, doubts = {n: float(v) for n, v in ratios.values.items()}, []
    if wrong := [n for n, v in values.items() if not (math.isfinite(v) and v > 0)]:
        shown = [f"{n} = {terse(values[n])}" for n in wrong]
        doubts.append(found("rls.impossible", "doubt", *wrong, values=shown))
    # The ratios do not use p2, so it serves as a check.
    p2, expected = float(ratios.p2), float(ratios.p2_expected)
    if abs(p2 / expected - 1.0) > _MEANT:
        doubts.append(found("rls.other-structure", value=p2, expected=expected))
    return values, doubts


def _bias(errors: Float[np.ndarray, " k"], y: Float[np.ndarray, " N"]) -> list[Finding]:
    """Return the finding that noise on past measured outputs biases least squares: the one-step
    errors are then not white."""
    # The first errors are excluded, because P is still near its initial value.
    errors = errors[min(_STARTING, errors.size // 4) :]
    rounding = np.sqrt(np.mean(errors**2)) < 1e-8 * np.sqrt(np.mean(y**2))
    return [] if rounding or whiteness(errors).white else [found("rls.not-white")]
