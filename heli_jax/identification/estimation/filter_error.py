"""Filter error: the innovations of a Kalman filter, over their standard deviations.

Maximum likelihood for vehicles with a disturbance (Jategaonkar, 2006, chapter 5). The disturbance's
intensity and correlation time, and the sd of the measurement noise, are estimated with the
parameters.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.model import Model, correlation_of, initial_sd_of
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight, labels
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.kalman import (
    Estimate,
    Innovations,
    by_name,
    corrected,
    filter_of,
    filter_start,
    innovations,
)
from heli_jax.identification.estimation.noise_scales import (
    correction,
    corrections_at,
    corrections_changed,
    first_corrections,
)
from heli_jax.identification.estimation.objective import Objective, RowTags
from heli_jax.identification.estimation.residual import Residuals
from heli_jax.identification.estimation.shared_covariance import innovations_together
from heli_jax.identification.estimation.simulated_flights import (
    driven,
    measured_count,
    measured_signals,
    measurement_sd,
    signal_numbers,
    signals,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    Unknowns,
    unpack,
)
from heli_jax.simulation.options import SimulationOptions
from heli_jax.simulation.simulate import simulate

# Records of a fitted model with new random disturbances.


_BATCH = 8
"""Records that are drawn in one batch."""


def disturbed_records(reached: Solution, u: Unknowns, i: int, keys: Array) -> dict[str, Array]:
    """Return the outputs (runs, N) by name, with a disturbance drawn for each key."""
    layout, drive = reached.layout, driven(reached.layout, reached.data, u, i)
    model, params, dtype = layout.model, drive.params, reached.z.dtype
    first = drive.state if drive.state is not None else model.initial_state(params)
    names, sds = naming.names(model.State), initial_sd_of(model, params, dtype)
    # The correlation is factored without the sds, which may be zero.
    factor = sds[:, None] * jnp.linalg.cholesky(correlation_of(model, params, dtype))

    @jax.jit
    def run(key: Array) -> Any:
        of_first, of_noise = jax.random.split(key)
        drawn = jnp.sum(factor * jax.random.normal(of_first, (1, len(names)), dtype), axis=1)
        begin = {n: getattr(first, n) + drawn[names.index(n)] for n in model.random_states}
        return simulate(
            model,
            params,
            drive.inputs,
            dt=drive.dt,
            initial_state=naming.replace(first, **begin),
            solver=layout.solver,
            substeps=layout.substeps,
            key=of_noise,
            hold=layout.hold(i),
        ).outputs

    return naming.asdict(jax.lax.map(run, keys, batch_size=_BATCH))


_DIGITS = 1e13
"""Ratio of the variances of innovation and measurement beyond which float64 has no digits left."""
_TOLERANCE = 1e-6
_CORRECTED = 0.02
"""Relative change of a correction's slope above which the parameters change too."""


class FilterError(Objective):
    """One-step predictions of an (extended) Kalman filter against the measured outputs."""

    noise_model = "disturbance"

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """Return the innovations over their sd, and rows that make J'J the Fisher information."""
        by_flight = filtered_flights(layout, data, noise, u)
        rows, added = _likelihood_rows(layout, data, noise, u, by_flight)
        return Residuals(rows, None, by_flight, added)

    def tags(self, layout: Layout, data: Data, count: int) -> RowTags:
        """Return the row tags: innovations, one row of the mean log variance, and the variances of
        the same samples."""
        tags = super().tags(layout, data, count)
        n = int(tags.residual.sum())
        for of_rows in tags[:3]:
            of_rows[count - n :] = of_rows[:n]
        return tags

    def scaled_outputs(self, problem: Problem) -> tuple[str, ...]:
        """Return all outputs, unless their noise is fixed."""
        if "sigma_y" in problem.fixed_noise:
            return ()
        return tuple(sorted({n for f in problem.training for n in f.outputs}))

    def first_noise(self, problem: Problem, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """Add the corrections, which are zero before the first relaxation."""
        return noise._replace(corrections=first_corrections(problem))

    def relax(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """Return z, and the noise with the corrections at z; its sds are part of z."""
        if not noise.corrections:
            return z, noise
        e, measured = evaluate(layout, data, noise, z), signal_numbers(layout, data).size
        corrections = corrections_at(layout, data, noise, e, z, measured)
        return z, noise._replace(corrections=corrections)

    def noise_matters(self, problem: Problem, layout: Layout, before: Noise, after: Noise) -> bool:
        """True if a correction changed enough to move the optimum."""
        return corrections_changed(before, after) > _CORRECTED

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Return the log-likelihood of the innovations (Schweppe, 1965)."""
        n = measured_count(data)
        squares, logs = innovation_sums(e, noise)
        # The sums use log(s / sd^2), so the sd restore the units of the outputs.
        for flight, sd in zip(data.flights, noise.sd, strict=True):
            for k, y in flight.outputs.items():
                logs += 2.0 * float(np.log(sd[k])) * int(np.isfinite(np.asarray(y)).sum())
        return float(-0.5 * (squares + n * np.log(2.0 * np.pi) + logs))

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """Return the records; each run has its own disturbance."""
        return [
            disturbed_records(
                reached, u, i, jax.random.split(jax.random.fold_in(jax.random.key(seed), i), runs)
            )
            for i in range(len(reached.data.flights))
        ]

    def ill_conditioned(self, problem: Problem, e: Evaluation, sd: dict[str, float]) -> bool:
        """True if the filter lost precision: variances are negative or too large for float64."""
        ratios = np.concatenate(
            [
                np.asarray(s) / sd[f"{label}/{n}"] ** 2
                for label, flight in zip(labels(problem.training), e.innovations, strict=True)
                for n, s in flight.variance.items()
            ]
        )
        # NaN marks a missing sample, unless the filter itself failed.
        ratios = ratios[~np.isnan(ratios)] if np.isfinite(e.r).all() else ratios
        return bool(
            not ratios.size
            or not np.isfinite(ratios).all()
            # The variance of an innovation cannot be below that of its measurement.
            or ratios.min() < 1.0 - _TOLERANCE
            or ratios.max() > _DIGITS
        )

    def findings(
        self, at: Solution, e: Evaluation, names: Sequence[str], ill: bool
    ) -> list[Finding]:
        """Return findings on the filter."""
        if ill:
            return [found("search.ill-conditioned")]
        size = float(np.sqrt(innovation_sums(e, at.noise)[0] / measured_count(at.data)))
        # The intervals are wrong by the same factor.
        if 0.8 < size < 1.25:
            return []
        return [found("noise.innovations-size", value=size, distrusts=at.layout.of_interest)]


def filtered_flights(
    layout: Layout, data: Data, noise: Noise, u: Unknowns
) -> tuple[Innovations, ...]:
    """Return the innovations of every flight."""
    together: dict[int, Innovations] = {}
    for group in layout.one_covariance:
        theirs = innovations_together(layout, data, noise, u, group)
        together |= dict(zip(group, theirs, strict=True))
    for i in set(range(len(data.flights))) - set(together):
        positional, options = _filter_arguments(layout, data, noise, u, i)
        together[i] = innovations(*positional, options)
    return tuple(together[i] for i in range(len(data.flights)))


def _filter_arguments(
    layout: Layout, data: Data, noise: Noise, u: Unknowns, i: int
) -> tuple[tuple[Model, Any, Any, dict[str, Array], dict[str, Any]], SimulationOptions]:
    """Return the arguments of `kalman.innovations` for the i-th flight."""
    drive = driven(layout, data, u, i)
    measured = {n: y - u.biases[i][n] for n, y in data.flights[i].outputs.items()}
    sd = {n: measurement_sd(u, n, s) for n, s in noise.sd[i].items()}
    options = SimulationOptions(
        dt=drive.dt,
        initial_state=drive.state,
        delay=u.shift,
        substeps=layout.substeps,
        hold=layout.hold(i),
    )
    return (layout.model, drive.params, drive.inputs, measured, sd), options


def _likelihood_rows(
    layout: Layout, data: Data, noise: Noise, u: Unknowns, by_flight: tuple[Innovations, ...]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    r"""Return rows, and what their sum of squares lacks of minus twice the log-likelihood.

    Rows are zero without a measurement. The rows are $e_k/\sqrt{s_k}$, and one row $\sqrt N$ with
    half of the derivative of $\sqrt N\,\overline{\log s}$, which is no square.

    These rows contain half of the variances' information ($\tfrac14 s'^2/s^2$ of $\tfrac12$), so
    the optimiser would take twice the step along the noise. Further rows of value zero have the
    derivative $\tfrac12 (s'_k/s_k - \overline{s'/s})$. They make J'J the Fisher information (Mehra,
    1970; Maine and Iliff, 1985, omit that part). The additional row contains the mean.
    """
    y, sd = measured_signals(layout, data, noise)
    at = signals(layout)
    seen = jnp.isfinite(y)
    # One replaces missing measurements, so that no derivative of a root or logarithm is NaN.
    s = jnp.where(seen, jnp.concatenate([by_flight[i].variance[n] for i, n in at]), 1.0)
    error = jnp.concatenate([by_flight[i].error[n] for i, n in at])
    rows = jnp.where(seen, error, 0.0) / jnp.sqrt(s)
    log_s = jnp.where(seen, jnp.log(s / sd**2), 0.0)
    count = jnp.sum(seen.astype(rows.dtype))
    mean = jnp.sum(log_s) / count
    whole = mean + correction(layout, noise, u) / count
    level = jax.lax.stop_gradient(whole)
    last = jnp.sqrt(count) * (1.0 + 0.5 * (whole - level))
    log_s = jnp.where(seen, log_s - mean, 0.0)
    # The last rows are zero; only the first term contributes a derivative.
    rows = jnp.concatenate([rows, last[None], 0.5 * (log_s - jax.lax.stop_gradient(log_s))])
    return rows, count * level


def innovation_sums(e: Evaluation, noise: Noise) -> tuple[float, float]:
    """Return the sums over all measurements of e^2/s and of log(s/sd^2)."""
    squares, logs = 0.0, 0.0
    with np.errstate(all="ignore"):  # the start may be unstable
        for flight, sd in zip(e.innovations, noise.sd, strict=True):
            for n, s in flight.variance.items():
                squares += float(np.nansum(flight.error[n] ** 2 / s))
                logs += float(np.nansum(np.log(s / sd[n] ** 2)))
    return squares, logs


OBJECTIVE = FilterError()


# Predictions some seconds ahead start from the filter's state. The simulation of an unstable
# vehicle diverges from any record, and any model predicts one step well.


SECONDS = 2.0
"""Length of a window, which starts from the filter's prediction [s]."""


def predictions_ahead(at: Solution, seconds: float = SECONDS) -> tuple[Innovations, ...]:
    """Return measured less predicted by flight, in windows that start from the filter's state.

    Args:
        at: the end of a fit by filter error.
        seconds: length of a window [s]; infinite for a simulation.
    """
    flights = [(float(f.dt), next(iter(f.outputs.values())).size) for f in at.data.flights]
    every = tuple(np.array(max(1, round(min(seconds / dt, n)))) for dt, n in flights)
    return jax.device_get(_errors(*at, every))


def expected_error(at: Solution, e: Evaluation) -> dict[str, float]:
    """Return, by output, the ratio of the simulation error's power to that explained by
    disturbance and noise."""
    missed: dict[str, float] = {}
    expected: dict[str, float] = {}
    for error, ahead in zip(e.raw, predictions_ahead(at, np.inf), strict=True):
        for n, variance in ahead.variance.items():
            seen = np.isfinite(error[n])
            with np.errstate(all="ignore"):
                power = float(np.var(error[n][seen])) * int(seen.sum())
                missed[n] = missed.get(n, 0.0) + power
                expected[n] = expected.get(n, 0.0) + float(np.nansum(variance))
    return {
        n: float(missed[n] / allowed) if np.isfinite(allowed) and allowed > 0 else 0.0
        for n, allowed in expected.items()
    }


@eqx.filter_jit
def _errors(
    layout: Layout, data: Data, noise: Noise, z: Array, every: tuple[np.ndarray, ...]
) -> tuple[Innovations, ...]:
    u = unpack(layout, data, z)
    return tuple(
        errors_ahead(*_filter_arguments(layout, data, noise, u, i), samples)
        for i, samples in enumerate(every)
    )


def errors_ahead(
    positional: tuple[Model, Any, Any, dict[str, Array], dict[str, Any]],
    options: SimulationOptions,
    every: int | np.ndarray,
) -> Innovations:
    """Return measured less predicted in windows of `every` samples, and its variance.

    Args:
        positional: model, params, inputs, measured and sd, as for `kalman.innovations`.
        every: samples of a window; each starts from the filter's prediction of its first sample.
    """
    drive, first, y, R = filter_start(*positional, options)
    filter_ = filter_of(drive)

    def step(carry: tuple[Estimate, Estimate], sample: Any) -> tuple[Any, Any]:
        filtered, ahead = carry
        y, begins, now = sample
        x, P = jax.tree.map(lambda f, a: jnp.where(begins, f, a), filtered, ahead)
        C, rest = filter_.measure(x, now)
        error = y - rest - jnp.sum(C * x[None, :], axis=1)
        variance = jnp.sum((C @ P) * C, axis=1) + R
        filtered, _ = corrected(filter_, filtered, R, y, now)
        moved = (_symmetric(filter_.move(*filtered, now)), _symmetric(filter_.move(x, P, now)))
        return moved, (error, jnp.where(jnp.isfinite(y), variance, jnp.nan))

    begins = jnp.arange(y.shape[0]) % every == 0
    _, (error, variance) = jax.lax.scan(step, (first, first), (y, begins, filter_.samples))
    return by_name(positional[3], error, variance)


def _symmetric(estimate: Estimate) -> Estimate:
    x, P = estimate
    return x, 0.5 * (P + P.T)
