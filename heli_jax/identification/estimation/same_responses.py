"""Other values of the parameters with the same responses to the inputs, from which a filter is
begun again.

Two modes may exchange their parts: a heave mode and an inflow with a slow damping and a quick lag
answer a collective like one with a quick damping and a slow lag. The inputs do not tell the two
from each other. A disturbance does, since it acts through one of the modes alone; but a search that
began on the wrong side ends there, with white innovations and a likelihood that lacks a few units.
Such values are found without any simulation, from the linear model's responses.
"""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.dynamics.jacobians import StateSpace, jacobians
from heli_jax.finding import note
from heli_jax.identification.estimation.disturbance_search import (
    NO_DISTURBANCE,
    begun_at,
    with_noise_guess,
)
from heli_jax.identification.estimation.multistart import Search, named_values
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    log_likelihood_of,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Data, Layout

_FACTORS = (1 / 10, 10, 1 / 30, 30)
"""by which each parameter is moved and held, until the others follow"""
_MOST_PARAMETERS = 8
"""that are asked: each costs as many searches as there are factors, of as many unknowns"""
_FREQUENCIES = 24
"""at which responses are compared, from the record's length to the samples'"""
_FAINT = 1e-3
"""of a response's largest gain, below which it is compared with that"""
_ALIKE = 1e-3
"""rms of the relative difference of responses that is none"""
_LARGE = 1e6
"""for a difference that is not finite"""
_MOVED = 0.1
"""relative change of a parameter from which on it is another value"""
_DETERMINED = 1e-6
"""smallest singular value over the largest, of the responses by the parameters: below, whole
valleys answer alike, of which the verdict tells"""
_STEP = 1e-6
"""of a coordinate, for differences"""
_STEPS = (10, 15)
"""evaluations at most for each parameter: with one of them held, and with none"""
_EVALUATIONS = 1000
"""of the responses in all: a second or two"""
_MOST = 2
"""other values that a filter is begun from"""
_BETTER = 0.1
"""log-likelihood by which an optimum is better than another"""


def better_of_same_responses(search: Search, optimum: RelaxedOptimum) -> RelaxedOptimum:
    """The best of an optimum and those that a search finds from other values with its responses.

    Args:
        search: the optimiser over the problem. Asked are linear models with one disturbance.
        optimum: where it ended.
    """
    layout = search.layout
    # Where the record shows no disturbance nothing tells such values apart.
    disturbed = optimum.ratio is None or optimum.ratio > NO_DISTURBANCE
    if not (
        bool(optimum.best.converged)
        and len(layout.sigmas) == 1
        and disturbed
        and search.problem.model.linear
        and 1 < len(layout.free) <= _MOST_PARAMETERS
    ):
        return optimum
    best, likelihood = optimum, _log_posterior(search, optimum)
    here = np.asarray(optimum.best.z, np.float64)[: len(layout.free)]
    for coordinates in same_responses(search.problem, layout, search.data, here):
        z = optimum.best.z.at[: coordinates.size].set(jnp.asarray(coordinates))
        # Initial states are those of the other values too: from zero they follow.
        z = z.at[layout.first_nuisance :].set(0.0)
        z = with_noise_guess(search, optimum._replace(best=optimum.best._replace(z=z)))
        again = begun_at(search, optimum, z)
        if not bool(again.best.converged) or not _differ(search, again, best):
            continue
        other = _log_posterior(search, again)
        if other > likelihood + _BETTER:
            said = (
                f"Other values of {', '.join(_changed(search, again, best))} answer the inputs "
                "alike: begun from these the filter found a better optimum (log-likelihood "
                f"{other:.1f} for {likelihood:.1f}), and this fit is the better one."
            )
            again, best = best, again.after(best, note("search.same-responses", said))
            other, likelihood = likelihood, other
    return best


def same_responses(
    problem: Problem, layout: Layout, data: Data, here: np.ndarray
) -> list[np.ndarray]:
    """Coordinates (q,) of other values of the free parameters whose responses to the inputs are the
    same: one or two, and none where the responses do not determine the parameters about `here`.

    Args:
        problem: whose model is linear.
        layout: what the unknowns are.
        data: the numbers of the problem.
        here: coordinates (q,) of the free parameters.
    """
    differ = _Difference(problem, layout, data, here)
    # Of the difference from here, which is zero.
    slopes = np.stack([differ(here + step) / _STEP for step in _STEP * np.eye(here.size)], axis=1)
    sizes = np.linalg.svd(slopes, compute_uv=False)
    if not (np.isfinite(slopes).all() and sizes[-1] > _DETERMINED * sizes[0]):
        return []
    values = _values(layout, data, here)
    ends: list[np.ndarray] = []
    for factor, i in itertools.product(_FACTORS, range(here.size)):
        if len(ends) == _MOST or differ.evaluations > _EVALUATIONS:
            break
        start = here.copy()
        limits = (data.sign[i], data.low[i], data.high[i])
        at = transforms.to_coordinate(layout.kinds[i], values[i] * factor, *limits)
        start[i] = float(at)
        end = _with_the_same(differ, start, i)
        if end is None:
            continue
        there = _values(layout, data, end)
        inside = zip(problem.free.values(), there, strict=True)
        if not all(transforms.inside(f, float(v)) for f, v in inside):
            continue
        # Of two lags in series that change places the verdict tells by itself.
        if np.allclose(np.sort(there), np.sort(values), rtol=_MOVED):
            continue
        known = [_values(layout, data, z) for z in ends]
        if not any(np.allclose(there, v, rtol=_MOVED) for v in known):
            ends.append(end)
    return ends


def _with_the_same(
    differ: Callable[[np.ndarray], np.ndarray], start: np.ndarray, held: int
) -> np.ndarray | None:
    """Coordinates (q,) with the same responses, searched from a start with one of them held first;
    None where it leads to none."""
    if not np.isfinite(start).all():
        return None
    others = [k for k in range(start.size) if k != held]

    # Here: `check` and most fits never ask for it, and its import takes as long as a small search.
    import scipy.optimize

    def partly(x: np.ndarray) -> np.ndarray:
        z = start.copy()
        z[others] = x
        return differ(z)

    # Held until the others have taken the parts that this one leaves, or it would come back.
    z = start.copy()
    z[others] = scipy.optimize.least_squares(
        partly, start[others], method="lm", max_nfev=_STEPS[0] * (start.size + 1)
    ).x
    end = scipy.optimize.least_squares(
        differ, z, method="lm", max_nfev=_STEPS[1] * (start.size + 1)
    )
    rms = float(np.sqrt(np.mean(end.fun**2)))
    return end.x if rms < _ALIKE and np.isfinite(end.x).all() else None


class _Difference:
    """The relative difference of the responses at coordinates (q,) from those at `here`, as real
    numbers (k,); large where it is not finite."""

    def __init__(self, problem: Problem, layout: Layout, data: Data, here: np.ndarray) -> None:
        flight = problem.training[0]
        duration = max(f.n_samples * f.dt for f in problem.training)
        omega = np.geomspace(2.0 * np.pi / duration, np.pi / flight.dt, _FREQUENCIES)
        self._s = 1j * omega[:, None, None]
        outputs = naming.names(problem.model.Outputs)
        self._rows = [outputs.index(n) for n in flight.outputs]
        self._matrices = _matrices_of(problem, layout, data)
        self._base = self._response(here)
        # An input without any effect on an output has no relative difference: one, of nothing.
        size = np.abs(self._base) + _FAINT * np.max(np.abs(self._base), axis=0)
        self._size = np.where(size > 0, size, 1.0)
        self.evaluations = 0

    def __call__(self, z: np.ndarray) -> np.ndarray:
        self.evaluations += 1
        with np.errstate(all="ignore"):
            r = ((self._response(z) - self._base) / self._size).ravel()
        r = np.concatenate([r.real, r.imag])
        return np.nan_to_num(np.clip(r, -_LARGE, _LARGE), nan=_LARGE)

    def _response(self, z: np.ndarray) -> np.ndarray:
        """(k, outputs, inputs)"""
        (A, B, C, D), delays = jax.device_get(self._matrices(jnp.asarray(z)))
        with np.errstate(all="ignore"):
            try:
                x = np.linalg.solve(self._s * np.eye(len(A)) - A, B[None] + 0j)
            except np.linalg.LinAlgError:  # a pole at one of the frequencies
                x = np.full((self._s.size, *B.shape), np.nan + 0j)
            return (C[self._rows] @ x + D[self._rows]) * np.exp(-self._s * delays)


def _matrices_of(problem: Problem, layout: Layout, data: Data) -> Callable[[jax.Array], Any]:
    """By coordinates (q,) of the free parameters the model's matrices and its inputs' delays."""
    limits = list(zip(data.sign, data.low, data.high, strict=True))
    known = {n: jnp.asarray(v) for n, v in problem.training[0].known.items()}
    late, inputs = dict(problem.model.delays), naming.names(problem.model.Inputs)

    @jax.jit
    def matrices(z: jax.Array) -> tuple[StateSpace, jax.Array]:
        each = zip(layout.kinds, z, limits, strict=True)
        values = [transforms.to_value(kind, at, *limit) for kind, at, limit in each]
        params = naming.replace(problem.vehicle, **dict(zip(layout.free, values, strict=True)))
        params = naming.replace(params, **known)
        delays = [jnp.asarray(getattr(params, late[n]) if n in late else 0.0) for n in inputs]
        return jacobians(problem.model, params), jnp.stack(delays)

    return matrices


def _values(layout: Layout, data: Data, z: np.ndarray) -> np.ndarray:
    """(q,) the free parameters' values at their coordinates, SI."""
    return np.array(list(named_values(layout, data, jnp.asarray(z)).values()))


def _differ(search: Search, one: RelaxedOptimum, other: RelaxedOptimum) -> bool:
    return bool(_changed(search, one, other))


def _changed(search: Search, one: RelaxedOptimum, other: RelaxedOptimum) -> dict[str, float]:
    """The free parameters in which an optimum differs from another, with its values."""
    here, there = (named_values(search.layout, search.data, o.best.z) for o in (one, other))
    return {n: v for n, v in here.items() if not abs(v - there[n]) <= _MOVED * abs(there[n])}


def _log_posterior(search: Search, optimum: RelaxedOptimum) -> float:
    """The log-likelihood, less what priors hold against the free parameters."""
    values = named_values(search.layout, search.data, optimum.best.z)
    against = [
        ((values[n] - f.prior.mean) / f.prior.sd) ** 2
        for n, f in search.problem.free.items()
        if f.prior is not None
    ]
    return log_likelihood_of(search, optimum) - 0.5 * sum(against)
