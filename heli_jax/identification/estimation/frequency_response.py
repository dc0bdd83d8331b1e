r"""Fit of a linear model to measured frequency responses.

With Z, U, E the transforms of instruments (or inputs), inputs, and measured less modelled outputs
in Hann windows, the error of the model's responses is

$$\Delta H = \overline{E Z^*}\; \overline{U Z^*}^{-1}.$$

The model passes through the same windows as the record, so that windows cause no bias. Its response
at the lines of the whole record replaces a simulation, so that it may be unstable. These lines lack
mean and Nyquist frequency, which windows remove. The effects of the record's ends are projected
out. Errors are complex and linear. The spectral matrix of the noise whitens them between outputs
and inputs; it is that of the errors' part that no response explains. Lines of a window are weighted
by their independence.

Sources: Pintelon and Schoukens (2012), chapters 2 and 9; Bendat and Piersol (2010), chapter 9;
Tischler and Remple (2012), chapters 7 to 12, for the approach. Their logarithmic errors and
coherence weights are not used, because they lose a factor of 2 to 10 in precision.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.analysis.response_agreement import (
    APART,
    ResponseAgreement,
    expected_interval,
    pair_agreements,
)
from heli_jax.analysis.spectra import Windowed, window_transforms
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.estimation.frequency_instrument import absent_instrument
from heli_jax.identification.estimation.frequency_lines import (
    Record,
    alike,
    at_each_line,
    at_lines,
    discretised,
    in_time_of,
    modelled,
    projection,
    real_rows,
    shared_of,
    sources,
)
from heli_jax.identification.estimation.objective import Objective, RowTags, untagged
from heli_jax.identification.estimation.output_error import OBJECTIVE as OUTPUT_ERROR
from heli_jax.identification.estimation.output_error import in_time
from heli_jax.identification.estimation.residual import Residuals
from heli_jax.identification.estimation.response_weights import (
    ResponseWeights,
    first_weights,
    noise_density,
    on_device,
    response_of,
    weighed,
)
from heli_jax.identification.estimation.simulated_flights import (
    by_output,
    least_noise,
    signals,
    simulated_at,
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


def _groups(layout: Layout, data: Data, weights: ResponseWeights) -> list[list[int]]:
    """Return groups of flights that have equal layouts and windows."""
    starts, groups = weights.windows.starts, dict[Any, list[int]]()
    for number, members in enumerate(alike(layout, data)):
        for i in members:
            if starts[i]:
                groups.setdefault((number, starts[i]), []).append(i)
    return list(groups.values())


class _InWindows(NamedTuple):
    """A group of flights in windows."""

    E: Complex[Array, "W k p f"]
    """Transforms of measured less modelled outputs."""
    effects: Complex[Array, "W k p n"]
    """Those of the effects of a record's ends, by state."""
    Z: Complex[Array, "f W k m"]
    """Transforms of the instruments, see `Windowed`."""


def _in_windows(
    layout: Layout,
    data: Data,
    w: Windowed,
    u: Unknowns,
    group: list[int],
    ends: Float[Array, "f n"] | None = None,
) -> _InWindows:
    """Send records and model of a group through the windows.

    Args:
        ends: factors of the effects, by flight; default zero.
    """
    outputs = [data.flights[i].outputs for i in group]
    # Zeros stand for samples outside of the windows.
    y = jnp.stack([jnp.stack([jnp.nan_to_num(o[n]) for n in w.outputs], axis=1) for o in outputs])
    N = y.shape[1]
    of_windows = dataclasses.replace(layout, outputs=(w.outputs,) * len(data.flights))
    m, driving = discretised(of_windows, data, u, group)
    record = Record(group[0], 0, N)
    (z, R), at = at_lines(m, record), sources(record, driving)
    if ends is not None:
        at = at._replace(ends=z[:, None, None] * ends.T[None].astype(z.dtype))

    def windows(y: Float[Array, "N p *c"]) -> Complex[Array, "W k p *c"]:
        signals, starts = y.reshape(N, -1).T, w.starts[group[0]]
        X = jnp.asarray(window_transforms(signals, starts, w.length, w.numbers, w.dt))
        return jnp.moveaxis(X, 0, -1).reshape(*X.shape[1:], *y.shape[1:])

    made = in_time_of(at_each_line(partial(modelled, m), R, at), N)
    H = jax.lax.stop_gradient(m.C)[None].astype(z.dtype) @ R
    first = np.cumsum([0, *(len(s) for s in w.starts)])
    return _InWindows(
        windows(jnp.moveaxis(y, 0, -1) - made),
        windows(in_time_of(H * z[:, None, None], N)),
        jnp.stack([w.Z[first[i] : first[i + 1]] for i in group]),
    )


def _whitened(weights: ResponseWeights, S: Complex[Array, "k p m c"]) -> Float[Array, "r c"]:
    """Return the responses of sums over all flights, in rows of variance 1."""
    w, (k, c) = weights.windows, (S.shape[0], S.shape[3])
    dH = jnp.einsum("kmz,kpzc->kpmc", weights.averages.P, S / len(w.Z))
    return real_rows(weights.whitening @ dH.reshape(k, -1, c))


def rows_of_responses(
    layout: Layout, data: Data, weights: ResponseWeights, u: Unknowns
) -> Float[Array, " r"]:
    """Return the whitened errors of all responses, with the effects of the ends projected out."""
    groups, (v, unknowns) = _groups(layout, data, weights), shared_of(u)
    at = jax.lax.stop_gradient(v)

    def errors(v: Array, ends: Sequence[Array | None]) -> Float[Array, " r"]:
        sums = []
        for group, factors in zip(groups, ends, strict=True):
            E, _, Z = _in_windows(layout, data, weights.windows, unknowns(v), group, factors)
            sums.append(jnp.einsum("fwkz,wkpf->kpz", jnp.conj(Z), E))
        return _whitened(weights, jnp.sum(jnp.stack(sums), axis=0)[..., None])[:, 0]

    # Each state of each flight gives one column of end effects.
    columns = []
    for group in groups:
        _, effects, Z = _in_windows(layout, data, weights.windows, unknowns(at), group)
        made = jnp.einsum("fwkz,wkpn->kpzfn", jnp.conj(Z), effects)
        columns.append(made.reshape(*made.shape[:3], -1))
    Q, S = projection(_whitened(weights, jnp.concatenate(columns, axis=3)))
    # Least squares gives the factors of the effects by group.
    factors = S @ (Q.T @ errors(at, [None] * len(groups)))
    each = jnp.split(factors, np.cumsum([c.shape[3] for c in columns])[:-1])
    ends = [v.reshape(len(group), -1) for v, group in zip(each, groups, strict=True)]
    # Variable projection (Kaufman): derivatives keep these factors fixed. Only unknowns shared by
    # all flights count, because nuisances have no effect here.
    J = jax.jacfwd(errors)(at, ends)
    rows, J = jax.lax.stop_gradient((errors(at, ends), J - Q @ (Q.T @ J)))
    return rows + J @ (v - at)


@eqx.filter_jit
def errors_in_windows(
    layout: Layout, data: Data, weights: ResponseWeights, z: Array
) -> Complex[Array, "W k p"]:
    """Return the transforms of measured less modelled outputs."""
    u, of_flight = unpack(layout, data, z), dict[int, Array]()
    # The ends are fitted to all windows, each output weighted by its noise, not only to the
    # responses.
    power = jnp.real(jnp.einsum("kii->ki", weights.density))

    def rows(v: Complex[Array, "W k p c"]) -> Float[Array, "r c"]:
        v = v / jnp.sqrt(power)[None, :, :, None].astype(v.dtype)
        return real_rows(v.reshape(-1, *v.shape[2:]))

    for group in _groups(layout, data, weights):
        E, effects, _ = _in_windows(layout, data, weights.windows, u, group)
        Q, S = projection(rows(effects))
        factors = (S @ (Q.T @ rows(E))).astype(E.dtype)
        left = E - jnp.einsum("nf,wkpn->wkpf", factors, effects)
        of_flight |= dict(zip(group, jnp.moveaxis(left, -1, 0), strict=True))
    return jnp.concatenate([of_flight[i] for i in sorted(of_flight)])


class FrequencyResponse(Objective):
    """Errors of the model's frequency responses, over all flights together."""

    noise_model = "spectrum"
    fits_responses = True

    def tags(self, layout: Layout, data: Data, count: int) -> RowTags:
        """Return empty tags, because rows are responses of all flights together."""
        return untagged(count)

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """Return the whitened errors of all responses, real and imaginary parts."""
        return Residuals(rows_of_responses(layout, data, noise.whitening, u), None)

    def refusal(self, problem: Problem) -> str | None:
        """Return the reason for nonlinear models, and for flights with too few windows."""
        if not problem.model.linear:
            return (
                f"model {problem.model.name} is not linear; expected frequency-error, which "
                "linearises it, output-error or filter-error"
            )
        refused = absent_instrument(problem)
        if refused is not None:
            return refused
        try:
            first_weights(problem, problem.training)
        except ValueError as e:
            return str(e)
        return None

    def first_noise(self, problem: Problem, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """Return the noise with the weights of the measured signals."""
        return noise._replace(whitening=on_device(first_weights(problem, flights)))

    def relax(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """Estimate the spectrum of the errors' part that no response explains."""
        z = in_time(layout, data, noise, z)
        weights = jax.device_get(noise.whitening)
        errors = np.asarray(errors_in_windows(layout, data, noise.whitening, z))
        density = noise_density(weights.windows, weights.averages, errors)
        weights = weighed(weights, density)
        level = -2.0 * weights.log_determinant / max(weights.numbers, 1.0)
        sd = _sd(layout, data, weights, z)
        return z, Noise(sd, np.asarray(level), on_device(weights))

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Return the log-likelihood of complex normal errors of the responses, in SI units of
        output over input.

        Args:
            noise: the noise that `e` was evaluated with.
        """
        weights: ResponseWeights = noise.whitening
        squares = float(np.sum(np.square(np.asarray(e.r)[: 2 * weights.used.size])))
        constant = weights.numbers * float(np.log(np.pi))
        return 2.0 * weights.log_determinant - 0.5 * squares - constant

    def numbers(self, layout: Layout, data: Data, noise: Noise) -> int:
        """Return the number of values from which the noise's spectrum is estimated."""
        # The responses do not determine the nuisances, so only the other unknowns are added.
        return int(noise.whitening.numbers_of_noise) + layout.determined

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """Return the simulated flights; the noise includes the disturbances."""
        return OUTPUT_ERROR.records(reached, u, runs, seed)

    def response_agreement(
        self, layout: Layout, data: Data, noise: Noise, z: Array
    ) -> ResponseAgreement | None:
        """Return chi-squared and Tischler's J of every response."""
        weights = jax.device_get(noise.whitening)
        w, used = weights.windows, weights.used
        E = response_of(
            w, weights.averages, np.asarray(errors_in_windows(layout, data, noise.whitening, z))
        )
        H = response_of(w, weights.averages, w.Y)
        white = np.einsum("kab,kb->ka", weights.whitening, E.reshape(len(E), -1))
        ends = len(data.flights) * len(layout.states)
        taken = len(layout.of_interest)
        freedom = max(2.0 * weights.numbers - taken - ends, 1.0)
        low, high = expected_interval(freedom, weights.numbers_of_noise)
        pairs = pair_agreements(w, used, H, E, weights.variance(), weights.coherence)
        left_out = [f"{n}: its responses are not used, {why}." for n, why in w.left_out.items()]
        return ResponseAgreement(
            pairs,
            2.0 * float(np.sum(np.abs(white) ** 2)) / freedom,
            low,
            high,
            freedom,
            w.seconds,
            tuple((n, w.averages) for n in w.outputs),
            w.instruments,
            (*left_out, *(() if w.together else (APART,))),
        )


def _sd(layout: Layout, data: Data, weights: ResponseWeights, z: Array) -> tuple[dict, ...]:
    """Return, by flight and output, the sd of the residual in time.

    If the simulation diverges, it is the sd of the noise in the band.
    """
    runs = by_output(layout, jax.device_get(simulated_at(layout, data, z)))
    w, sd = weights.windows, [dict[str, Any]() for _ in data.flights]
    in_band = np.mean(np.real(np.einsum("kpp->kp", weights.density)), axis=0)
    in_band = np.sqrt(in_band * max(float(np.ptp(w.hz)), 1.0 / w.seconds))
    for i, name in signals(layout):
        y = np.asarray(data.flights[i].outputs[name])
        left = (y - runs[i][name])[np.isfinite(y)]
        # The square of a diverged simulation overflows.
        with np.errstate(all="ignore"):
            size = float(np.sqrt(np.mean(left**2)))
        if name in w.outputs and not size < np.nanstd(y):
            size = float(in_band[w.outputs.index(name)])
        sd[i][name] = np.asarray(max(size, least_noise(y)), y.dtype)
    return tuple(sd)


OBJECTIVE = FrequencyResponse()
