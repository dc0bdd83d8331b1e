r"""Fit of a linear model to measured frequency responses.

With Z, U, E the transforms of instruments (or inputs), inputs, and measured less modelled outputs
in Hann windows, the error of the model's responses is

$$\Delta H = \overline{E Z^*}\; \overline{U Z^*}^{-1}.$$

The model passes through the same windows as the record, so that windows cause no bias. Its bounded
solution replaces a simulation, so that it may be unstable. The effects of the record's ends are
projected out. Errors are complex and linear. The spectral matrix of the noise whitens them between
outputs and inputs; it is that of the errors' part that no response explains. Lines of a window are
weighted by their independence.

Sources: Pintelon and Schoukens (2012), chapters 2 and 9; Bendat and Piersol (2010), chapter 9;
Tischler and Remple (2012), chapters 7 to 12, for the approach. Their logarithmic errors and
coherence weights are not used, because they lose a factor of 2 to 10 in precision.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
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
    Driving,
    Matrices,
    alike,
    discretised,
    orthonormal,
    shared_of,
    with_shared,
)
from heli_jax.identification.estimation.objective import Objective, RowTags, untagged
from heli_jax.identification.estimation.output_error import OBJECTIVE as OUTPUT_ERROR
from heli_jax.identification.estimation.output_error import in_time
from heli_jax.identification.estimation.residual import Residuals
from heli_jax.identification.estimation.response_weights import (
    ResponseWeights,
    back,
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

# The model through the windows of the record.
#
# With $z = e^{i \pi (2 k + 1) / N}$ the sums $X = (zI - A_d)^{-1} B U$ are those of the solution
# with $x_N = -x_0$. It is bounded where a simulation diverges. The response over the record is the
# sum of this solution and of $n$ effects of the ends: those of stable modes decay from the start,
# those of unstable ones towards the end. Lines half-way between the Fourier lines avoid the pole of
# an integrator.
#
# Sources: Devasia, Chen and Paden (1996) for bounded solutions of unstable plants; Golub and
# Pereyra (1973) and Kaufman (1975) for the projection.


def bounded_outputs(
    m: Matrices,
    driving: Driving,
    R: Complex[Array, "K n n"],
    ends: Float[Array, " n"] | None = None,
) -> Float[Array, "p N"]:
    """Return the outputs over a record by the bounded solution.

    Args:
        R: result of `inverses`.
        ends: factors of `effects_of_ends`; default zero.
    """
    z, turns = _lines(len(driving.U))
    U = _at_lines(driving.U, turns) @ m.B.T.astype(z.dtype)
    if ends is not None:
        U = U + z[:, None] * ends.astype(z.dtype)[None]
    # Products replace the derivative of an inverse: dY = H (dAd X + dU) + dC X. The differences are
    # zero, but their derivatives are not.
    X = jax.lax.stop_gradient(jnp.einsum("kij,kj->ki", R, U))
    C = jax.lax.stop_gradient(m.C).astype(z.dtype)
    dA, dC = ((v - jax.lax.stop_gradient(v)).astype(z.dtype) for v in (m.Ad, m.C))
    lines = jnp.einsum("kpn,kn->pk", C[None] @ R, U + X @ dA.T) + dC @ X.T
    return _in_time(lines, turns) + m.D @ driving.held.T


def inverses(m: Matrices, samples: int) -> Complex[Array, "K n n"]:
    """Return (zI - Ad)^-1 at the lines of a record, without a derivative."""
    z, _ = _lines(samples)
    Ad = jax.lax.stop_gradient(m.Ad).astype(z.dtype)
    return jnp.linalg.inv(z[:, None, None] * jnp.eye(len(Ad), dtype=z.dtype)[None] - Ad[None])


def effects_of_ends(m: Matrices, R: Complex[Array, "K n n"], samples: int) -> Array:
    """Return the effects (p, n, N) of a record's ends on the outputs, for each state."""
    z, turns = _lines(samples)
    H = jax.lax.stop_gradient(m.C)[None].astype(z.dtype) @ R
    return _in_time(jnp.moveaxis(H * z[:, None, None], 0, -1), turns)


def _lines(N: int) -> tuple[np.ndarray, np.ndarray]:
    """Return half of the lines z (K,) (the rest are conjugates), and exp(i pi t / N) (N,)."""
    # With odd N the line at the Nyquist frequency is its own conjugate.
    k = np.arange((N + 1) // 2)
    return np.exp(1j * np.pi * (2 * k + 1) / N), np.exp(1j * np.pi * np.arange(N) / N)


def _at_lines(v: Float[Array, "N *c"], turns: Complex[np.ndarray, " N"]) -> Complex[Array, "K *c"]:
    back = np.conj(turns).reshape(-1, *(1 for _ in v.shape[1:]))
    return jnp.fft.fft(v.astype(turns.dtype) * back, axis=0)[: (turns.size + 1) // 2]


def _in_time(
    lines: Complex[Array, "*c K"], turns: Complex[np.ndarray, " N"]
) -> Float[Array, "*c N"]:
    N, K = turns.size, lines.shape[-1]
    weights = np.full(K, 2.0, turns.dtype)
    if N % 2:
        weights[-1] = 1.0
    of_lines, in_time = (v.reshape(*(1 for _ in lines.shape[1:]), -1) for v in (weights, turns))
    return jnp.real(jnp.fft.ifft(lines * of_lines, N, axis=-1) * in_time)


def _groups(layout: Layout, data: Data, weights: ResponseWeights) -> list[list[int]]:
    """Return groups of flights that have windows and equal layouts."""
    return [g for g in alike(layout, data) if weights.windows.starts[g[0]]]


class _Measured(NamedTuple):
    """Windows of a flight."""

    y: Float[Array, "p N"]
    """Measured outputs; zero without measurement."""
    Z: Array | np.ndarray
    """Instruments in windows (W, k, m), see `Windowed`."""
    seen: Array | np.ndarray
    """Measured outputs of each window (W, p)."""


def _measured(data: Data, w: Windowed, members: list[int]) -> _Measured:
    """Return the windows of some flights, with a leading axis."""
    first, made = np.cumsum([0, *(len(s) for s in w.starts)]), []
    for i in members:
        outputs, own = data.flights[i].outputs, slice(first[i], first[i + 1])
        absent = jnp.zeros_like(next(iter(outputs.values())))
        y = jnp.stack([jnp.nan_to_num(outputs.get(n, absent)) for n in w.outputs])
        made.append(_Measured(y, w.Z[own], w.seen[own]))
    return jax.tree.map(lambda *v: jnp.stack(v), *made)


def _by_flight(
    layout: Layout,
    data: Data,
    weights: ResponseWeights,
    u: Unknowns,
    group: list[int],
    ends: Float[Array, "f n"] | None,
    body: Callable[[Array, Array, _Measured], Any],
) -> Any:
    """Return `body(E, effects, measured)` of each flight of a group, with a leading axis.

    E (p, W, k) are the errors of the outputs in windows, effects (p, n, W, k) those of the record's
    ends.

    Args:
        ends: factors of the effects, by flight; default zero.
    """
    w = weights.windows
    N = next(iter(data.flights[group[0]].outputs.values())).shape[0]
    of_windows = dataclasses.replace(layout, outputs=(w.outputs,) * len(data.flights))
    m, driving = discretised(of_windows, data, u, group)

    def windows(y: Array) -> Complex[Array, "p *c W k"]:
        E = window_transforms(y.reshape(-1, N), w.starts[group[0]], w.length, w.numbers, w.dt)
        return jnp.asarray(E).reshape(*y.shape[:-1], *E.shape[1:])

    R = inverses(m, N)
    effects = windows(effects_of_ends(m, R, N))

    def of_one(one: tuple[Driving, _Measured, Array | None]) -> Any:
        driving, measured, ends = one
        left = measured.y - bounded_outputs(m, driving, R, ends)
        return body(windows(left), effects, measured)

    # Flights are processed one at a time, because the derivatives of one fill the caches.
    return jax.lax.map(of_one, (driving, _measured(data, w, group), ends))


def _cross(measured: _Measured, E: Complex[Array, "p c W k"]) -> Complex[Array, "k p m c"]:
    """Return the products with the instruments in windows, summed over a flight."""
    E = E * measured.seen.T[:, None, :, None].astype(E.dtype)
    return jnp.einsum("wkz,pcwk->kpzc", jnp.conj(measured.Z), E)


def _summed(each: Iterable[Array]) -> Array:
    return jnp.sum(jnp.concatenate(list(each)), axis=0)


def _whitened(weights: ResponseWeights, S: Complex[Array, "k p m c"]) -> Float[Array, "r c"]:
    """Return the responses of sums over all flights, in rows of variance 1."""
    w, (k, c) = weights.windows, (S.shape[0], S.shape[3])
    S = S / jnp.sum(w.seen, axis=0).astype(S.dtype)[None, :, None, None]
    dH = jnp.einsum("pkmz,kpzc->kpmc", weights.averages.P, S)
    rows = weights.whitening @ dH.reshape(k, -1, c)
    # The real part of a complex normal error has half of its variance.
    return 2.0**0.5 * jnp.concatenate([jnp.real(rows), jnp.imag(rows)]).reshape(-1, c)


def rows_of_responses(
    layout: Layout, data: Data, weights: ResponseWeights, u: Unknowns
) -> Float[Array, " r"]:
    """Return the whitened errors of all responses, with the effects of the ends projected out."""
    v, groups = shared_of(layout, u), _groups(layout, data, weights)
    at, rest = jax.lax.stop_gradient((v, u))

    def sums(v: Array, ends: Sequence[Array | None], body: Callable[..., Any]) -> list[Any]:
        here = with_shared(layout, rest, v)
        each = zip(groups, ends, strict=True)
        return [_by_flight(layout, data, weights, here, g, end, body) for g, end in each]

    def with_effects(E: Array, effects: Array, own: _Measured) -> Any:
        return _cross(own, E[:, None]), _cross(own, effects)

    made = sums(at, [None] * len(groups), with_effects)
    rows = _whitened(weights, _summed(S for S, _ in made))[:, 0]
    # Each state of each flight gives one column of end effects.
    columns = [jnp.moveaxis(e, 0, 3).reshape(*e.shape[1:4], -1) for _, e in made]
    basis = _whitened(weights, jnp.concatenate(columns, axis=3))
    S = orthonormal(basis.T @ basis)
    Q = basis @ S
    along = Q.T @ rows
    # Least squares gives the factors of the effects by group.
    each = jnp.split(S @ along, np.cumsum([c.shape[3] for c in columns])[:-1])
    ends = [v.reshape(len(e), -1) for v, (_, e) in zip(each, made, strict=True)]

    def errors(v: Array) -> Array:
        return _whitened(
            weights, _summed(sums(v, ends, lambda E, _, own: _cross(own, E[:, None])))
        )[:, 0]

    # Variable projection (Kaufman): derivatives keep these factors fixed. Only unknowns shared by
    # all flights count, because nuisances have no effect here.
    J = jax.jacfwd(errors)(at)
    rows, J = jax.lax.stop_gradient((rows - Q @ along, J - Q @ (Q.T @ J)))
    return rows + J @ (v - at)


@eqx.filter_jit
def errors_in_windows(
    layout: Layout, data: Data, weights: ResponseWeights, z: Array
) -> Complex[Array, "W k p"]:
    """Return the transforms of measured less modelled outputs; zero for unmeasured outputs."""
    u, of_flight = unpack(layout, data, z), dict[int, Array]()
    # The ends are fitted to all windows, each output weighted by its noise, not only to the
    # responses.
    power = jnp.real(jnp.einsum("kii->ki", weights.density))

    def left(E: Array, effects: Array, own: _Measured) -> Array:
        seen = own.seen.T[:, :, None].astype(E.dtype)
        scale = seen / jnp.sqrt(power).T[:, None, :].astype(E.dtype)

        def rows(v: Array) -> Array:
            v = jnp.moveaxis(v * scale[:, None], 1, -1).reshape(-1, v.shape[1])
            return jnp.concatenate([jnp.real(v), jnp.imag(v)])

        basis = rows(effects)
        S = orthonormal(basis.T @ basis)
        ends = S @ (S.T @ (basis.T @ rows(E[:, None])[:, 0]))
        return (E - jnp.einsum("n,pnwk->pwk", ends.astype(E.dtype), effects)) * seen

    for group in _groups(layout, data, weights):
        made = _by_flight(layout, data, weights, u, group, None, left)
        of_flight |= {i: jnp.moveaxis(made[j], 0, -1) for j, i in enumerate(group)}
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
                "takes it linear about where it flies, output-error or filter-error"
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
        weights = back(noise.whitening)
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

    def errors_in_windows(
        self, layout: Layout, data: Data, noise: Noise, z: Array
    ) -> Complex[Array, "W k p"]:
        """Return the transforms of measured less modelled outputs; zero for unmeasured outputs."""
        return errors_in_windows(layout, data, noise.whitening, z)

    def response_agreement(
        self, layout: Layout, data: Data, noise: Noise, z: Array
    ) -> ResponseAgreement | None:
        """Return chi-squared and Tischler's J of every response."""
        weights = back(noise.whitening)
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
        left_out = [f"{n}: its responses take no part, {why}." for n, why in w.left_out.items()]
        return ResponseAgreement(
            pairs,
            2.0 * float(np.sum(np.abs(white) ** 2)) / freedom,
            low,
            high,
            freedom,
            w.seconds,
            tuple(zip(w.outputs, w.averages.tolist(), strict=True)),
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
