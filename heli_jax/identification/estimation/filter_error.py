"""Filter error: the innovations of a Kalman filter, over their standard deviations.

Maximum likelihood where a disturbance acts on the machine (Jategaonkar, 2006, chapter 5): its
intensity and correlation time are estimated beside the parameters, the scale of the measurement
noise is concentrated out of the likelihood unless it is given.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.model import correlation_of, initial_sd_of
from heli_jax.identification.estimation.estimator import (
    Estimator,
    Evaluation,
    Residuals,
    measured_count,
    measured_signals,
    signals,
)
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.kalman import Innovations, innovations
from heli_jax.identification.estimation.simulated_flights import driven
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    Unknowns,
    unpack,
)
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.simulation.simulate import simulate

_FLOOR = 1e-3
"""The likelihood's row stays real however far the noise falls; the next round has another level."""
_BLIND = 1e4
"""so many times the signal is a noise from which a filter learns nothing"""
_DIGITS = 1e13
"""Variance of an innovation over that of the measurement beyond which float64 has no digits left
for what the measurement says of the state."""
_TOLERANCE = 1e-6
_FELL = 0.9
"""fall of the noise (in the log of the variance) past which the likelihood's row shows no more"""
_BATCH = 8
"""records that are drawn side by side"""


class FilterError(Estimator):
    """One-step predictions of an (extended) Kalman filter against the measured outputs."""

    errors = "innovations"
    process_noise = True
    shared_noise = True
    rows_are_samples = False
    least_squares = False

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """The innovations over their sd, and what makes their Jacobian Fisher's information."""
        by_flight = filtered_flights(layout, data, noise, u)
        return Residuals(_likelihood_rows(layout, data, noise, by_flight), None, by_flight)

    def one_program(self, layout: Layout) -> bool:
        """A filter takes longer to evaluate than a step to be called for."""
        return False

    def scaled_outputs(self, problem: Problem) -> tuple[tuple[str, ...], bool]:
        """With sigma_w and sigma_y unknown their common factor is concentrated out, and every
        output but the first has a factor of its own; with sigma_w given all outputs have one."""
        if "sigma_y" in problem.fixed_noise:
            return (), False
        concentrated = "sigma_w" not in problem.fixed_noise
        outputs = tuple(sorted({n for f in problem.training for n in f.outputs}))
        return outputs[concentrated:], concentrated

    def with_level(self, data: Data, e: Evaluation, noise: Noise) -> Noise:
        """The noise with the level that the innovations show."""
        level = innovation_sums(e, noise)[1] / measured_count(data)
        level = level if np.isfinite(level) else 0.0
        return noise._replace(log_variance_ratio=np.asarray(level, noise.log_variance_ratio.dtype))

    def relax(
        self, layout: Layout, data: Data, e: Evaluation, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """All noise changes by one factor, that of the disturbance in z included, so that the
        optimum stays where it is."""
        n = measured_count(data)
        freedom = n / max(n - layout.determined, 1)
        squares, logs = innovation_sums(e, noise)
        level = np.asarray(logs / n, noise.log_variance_ratio.dtype)
        if not layout.concentrated:
            return z, noise._replace(log_variance_ratio=level)
        factor = np.sqrt(squares / n * freedom)
        if "sigma_w" in layout.disturbance:
            at = layout.disturbance_at("sigma_w")
            z = z.at[at].add(jnp.asarray(np.log(factor), z.dtype))
        sd = tuple({k: np.asarray(s * factor, s.dtype) for k, s in one.items()} for one in noise.sd)
        return z, Noise(sd, level)

    def noise_matters(self, problem: Problem, layout: Layout, fall: float) -> bool:
        """Only where priors are weighed against a scale that is concentrated out, or where the
        noise fell past what the likelihood's row can show."""
        if layout.concentrated:
            return any(f.prior for f in problem.free.values())
        return fall > _FELL

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Of the innovations (Schweppe, 1965), at the scale of the greatest likelihood where that
        is concentrated out."""
        n = measured_count(data)
        squares, logs = innovation_sums(e, noise)
        for flight, sd in zip(data.flights, noise.sd, strict=True):
            for k, y in flight.outputs.items():
                logs += 2.0 * float(np.log(sd[k])) * int(np.isfinite(np.asarray(y)).sum())
        if layout.concentrated:
            return float(-0.5 * (n * (1.0 + np.log(2.0 * np.pi * squares / n)) + logs))
        return float(-0.5 * (squares + n * np.log(2.0 * np.pi) + logs))

    def noise_unknowns(self, layout: Layout) -> int:
        """The common factor; the others stand in z."""
        return int(layout.concentrated)

    def log_likelihood_lost(
        self, layout: Layout, cost: np.ndarray | float, first: float, n: int
    ) -> Any:
        """With the scale concentrated out the cost is the variance, whose logarithm counts."""
        return n * (np.log(cost / first) if layout.concentrated else cost - first)

    def log_density(self, layout: Layout, data: Data, rows: Float[Array, " n"]) -> Array:
        """The scale of all noise is integrated out together, unless it was given."""
        if not layout.concentrated:
            return -0.5 * jnp.sum(rows**2)
        counted = [jnp.isfinite(y) for f in data.flights for y in f.outputs.values()]
        n = jnp.sum(jnp.concatenate(counted).astype(rows.dtype))
        return -0.5 * n * jnp.log(jnp.sum(rows**2))

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """Each run with a disturbance drawn anew."""
        return [
            _disturbed(
                reached, u, i, jax.random.split(jax.random.fold_in(jax.random.key(seed), i), runs)
            )
            for i in range(len(reached.data.flights))
        ]

    def against_expected(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation, z: Array
    ) -> dict[str, float]:
        """By output, the power of the simulation's error over that which disturbance and noise
        make.

        A filter whose measurements are all but noise never corrects its state: the variance of its
        innovations is then that of a simulation's error. The program is the one that is compiled.
        """
        blinding = tuple(
            {
                n: np.asarray(_BLIND * _root_mean_square(y), np.asarray(sd[n]).dtype)
                for n, y in f.outputs.items()
            }
            for f, sd in zip(data.flights, noise.sd, strict=True)
        )
        blind = evaluate(layout, data, noise._replace(sd=blinding), z)
        scales = unpack(layout, data, z).scales
        missed: dict[str, float] = {}
        expected: dict[str, float] = {}
        for error, one, big, sd in zip(e.raw, blind.innovations, blinding, noise.sd, strict=True):
            for n, s in one.variance.items():
                factor = float(scales.get(n, 1.0)) ** 2
                of_state = np.maximum(np.asarray(s) - float(big[n]) ** 2 * factor, 0.0)
                seen = np.isfinite(error[n])
                with np.errstate(all="ignore"):
                    power = float(np.var(error[n][seen])) * int(seen.sum())
                    allowed = float(np.nansum(of_state + float(sd[n]) ** 2 * factor))
                missed[n] = missed.get(n, 0.0) + power
                expected[n] = expected.get(n, 0.0) + allowed
        return {
            n: float(missed[n] / allowed) if np.isfinite(allowed) and allowed > 0 else 0.0
            for n, allowed in expected.items()
        }

    def ill_conditioned(self, problem: Problem, e: Evaluation, sd: dict[str, float]) -> bool:
        """Whether the filter has lost its digits: variances that are none, or beyond all digits."""
        ratios = np.concatenate(
            [
                np.asarray(s) / sd[f"{label}/{n}"] ** 2
                for label, one in zip(labels(problem.training), e.innovations, strict=True)
                for n, s in one.variance.items()
            ]
        )
        ratios = ratios[~np.isnan(ratios)] if np.isfinite(e.r).all() else ratios
        return bool(
            not ratios.size
            or not np.isfinite(ratios).all()
            or ratios.min() < 1.0 - _TOLERANCE
            or ratios.max() > _DIGITS
        )

    def notes(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation, ill: bool
    ) -> list[str]:
        """What is wrong with the filter, and the remedy."""
        if ill:
            return [
                "The Kalman filter is ill-conditioned: next to the disturbance the measurement "
                "noise is too small for the digits of a computer. These numbers are no result. "
                "State a measurement noise (sd) of at least the log's resolution, or begin with a "
                "smaller sigma_w."
            ]
        if layout.concentrated:
            return []
        size = float(np.sqrt(innovation_sums(e, noise)[0] / measured_count(data)))
        if 0.8 < size < 1.25:
            return []
        return [
            f"The innovations are {size:.3g} times as large as the fixed noise lets expect: the "
            "intervals do not hold. Leave sigma_y or sigma_w free, or correct them."
        ]


def filtered_flights(
    layout: Layout, data: Data, noise: Noise, u: Unknowns
) -> tuple[Innovations, ...]:
    """The innovations of every flight."""
    out = []
    each = zip(data.flights, u.states, u.biases, noise.sd, strict=True)
    for i, (flight, state, bias, sd) in enumerate(each):
        params, inputs = driven(layout, data, u, i)
        out.append(
            innovations(
                layout.model,
                params,
                inputs,
                {n: y - bias[n] for n, y in flight.outputs.items()},
                {n: s * u.scales[n] if n in u.scales else s for n, s in sd.items()},
                dt=flight.dt,
                initial_state=state,
                delay=u.shift,
                substeps=layout.substeps,
                hold=layout.hold(i),
            )
        )
    return tuple(out)


def _likelihood_rows(
    layout: Layout, data: Data, noise: Noise, by_flight: tuple[Innovations, ...]
) -> Array:
    r"""Rows whose sum of squares is minus twice the log-likelihood but for a constant; zero where
    nothing is measured.

    $e_k/\sqrt{s_k}$, and with the common scale of all noise concentrated out each times
    $\exp(\tfrac12(\overline{\log s} - level))$; else one row more, whose square is
    $N(1 + \overline{\log s} - level)$.

    These alone would hold half of what the variances tell ($\tfrac14 s'^2/s^2$ of $\tfrac12$),
    and the optimiser would go twice as far as it should along the noise. As many rows again, zero
    themselves, have the derivative $\tfrac12 (s'_k/s_k - \overline{s'/s})$: with them J'J is
    Fisher's information (Mehra, 1970; Maine and Iliff, 1985, leave that part out). The mean is
    taken off since it is known from elsewhere: with the scale concentrated out it tells nothing,
    else the one row more tells the same of it.
    """
    y, sd = measured_signals(layout, data, noise)
    at = signals(layout)
    seen = jnp.isfinite(y)
    s = jnp.where(seen, jnp.concatenate([by_flight[i].variance[n] for i, n in at]), 1.0)
    error = jnp.concatenate([by_flight[i].error[n] for i, n in at])
    rows = jnp.where(seen, error, 0.0) / jnp.sqrt(s)
    log_s = jnp.where(seen, jnp.log(s / sd**2), 0.0)
    count = jnp.sum(seen.astype(rows.dtype))
    mean = jnp.sum(log_s) / count
    above = mean - noise.log_variance_ratio
    if layout.concentrated:
        rows, last = rows * jnp.exp(0.5 * above), []
    else:
        last = [jnp.sqrt(count * jnp.maximum(1.0 + above, _FLOOR))[None]]
    log_s = jnp.where(seen, log_s - mean, 0.0)
    return jnp.concatenate([rows, *last, 0.5 * (log_s - jax.lax.stop_gradient(log_s))])


def innovation_sums(e: Evaluation, noise: Noise) -> tuple[float, float]:
    """Sums over all measurements of e^2/s and of log(s/sd^2)."""
    squares, logs = 0.0, 0.0
    with np.errstate(all="ignore"):  # an unstable start gives what it gives, and is judged later
        for one, sd in zip(e.innovations, noise.sd, strict=True):
            for n, s in one.variance.items():
                squares += float(np.nansum(one.error[n] ** 2 / s))
                logs += float(np.nansum(np.log(s / sd[n] ** 2)))
    return squares, logs


def _root_mean_square(y: Any) -> float:
    """Of what is measured (N,), never zero."""
    y = np.asarray(y)
    return max(float(np.sqrt(np.nanmean(np.square(y)))), 1e-300)


def _disturbed(reached: Solution, u: Any, i: int, keys: Array) -> dict[str, Array]:
    """By name the outputs (runs, N) with a disturbance drawn for each key."""
    flight, layout = reached.data.flights[i], reached.layout
    params, inputs = driven(layout, reached.data, u, i)
    start = u.states[i] if u.states[i] is not None else layout.model.initial_state(params)
    names, random = naming.names(layout.model.State), layout.model.random_states
    sds = initial_sd_of(layout.model, params, reached.z.dtype)
    # Factored without the sds, which may be zero.
    correlation = correlation_of(layout.model, params, reached.z.dtype)
    factor = sds[:, None] * jnp.linalg.cholesky(correlation)

    @jax.jit
    def run(key: Array) -> Any:
        first, second = jax.random.split(key)
        drawn = jnp.sum(factor * jax.random.normal(first, (1, len(names)), reached.z.dtype), axis=1)
        values = {n: getattr(start, n) + drawn[names.index(n)] for n in random}
        begin = naming.replace(start, **values)
        return simulate(
            layout.model,
            params,
            inputs,
            dt=flight.dt,
            initial_state=begin,
            solver=layout.solver,
            substeps=layout.substeps,
            key=second,
            hold=layout.hold(i),
        ).outputs

    return naming.asdict(jax.lax.map(run, keys, batch_size=_BATCH))


ESTIMATOR = FilterError()
