"""Which model the record asks for: likelihood, information criteria, nested tests in a table."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import scipy.special

from heli_jax import naming
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.model import Model
from heli_jax.identification.fit import fit
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Status


class Candidate(NamedTuple):
    """One model fitted to the record."""

    name: str
    status: Status
    log_likelihood: float
    unknowns: int
    aic: float
    bic: float
    white: bool
    """whether its residuals or innovations look white"""
    estimates: dict[str, float]


class Nested(NamedTuple):
    """A likelihood-ratio test of a model within another."""

    small: str
    large: str
    ratio: float
    """twice the log-likelihood gained"""
    degrees: int
    """unknowns added"""
    p_value: float
    """of the smaller model; on the safe side where it lies at a bound (sigma_w, kappa >= 0)"""


class Choice(NamedTuple):
    """All candidates, best AIC first, the nested tests, and the outcome in words."""

    candidates: tuple[Candidate, ...]
    nested: tuple[Nested, ...]
    sentences: tuple[str, ...]


class Alternatives(NamedTuple):
    """Problems by name, and which is nested in which: (small, large)."""

    problems: dict[str, Problem]
    nested: tuple[tuple[str, str], ...]


def alternatives(
    problem: Problem,
    model: Model,
    axis: str,
    *,
    without_stand: Model | None = None,
) -> Alternatives:
    """No disturbance, one pole and two poles on `axis`, all by filter error.

    Args:
        problem: gives vehicle, flights, free parameters and nuisances.
        model: the model without disturbance.
        without_stand: the same machine without its stand, where that is in question too; it is
            fitted without the stand's kappa and zeta.
    """
    problems: dict[str, Problem] = {}
    nested = []
    grounds = {"": (model, dict(problem.free))}
    if without_stand is not None:
        free = {n: f for n, f in problem.free.items() if n not in ("kappa", "zeta")}
        grounds[", no stand"] = (without_stand, free)
    for ending, (ground, free) in grounds.items():
        if not free:
            continue
        for words, poles in (("no disturbance", 0), ("one pole", 1), ("two poles", 2)):
            one = with_disturbance(ground, axis, max(poles, 1))
            given = naming.asdict(problem.vehicle)
            known = {n: given[n] for n in naming.names(one.Params) if n in given}
            fixed = tuple(n for n in problem.fixed_noise if poles)
            if not poles:
                # So little that it is none; the noise is then laid out as in the others.
                known |= {"sigma_w": jnp.asarray(1e-9 * problem.motion), "tau_w": jnp.asarray(1.0)}
                fixed = ("sigma_w", "tau_w", *(n for n in problem.fixed_noise if n == "sigma_y"))
            problems[words + ending] = replace(
                problem,
                model=one,
                vehicle=one.Params(**known),
                free=free,
                method="filter-error",
                fixed_noise=fixed,
            )
            if poles:
                nested.append((f"no disturbance{ending}", words + ending))
            if ending:
                nested.append((words + ending, words))
    return Alternatives(problems, tuple(nested))


def choose(
    problems: Mapping[str, Problem],
    nested: Sequence[tuple[str, str]] = (),
    *,
    progress: Callable[[str], None] | None = None,
    **how: Any,
) -> Choice:
    """Fit every problem and compare; `nested` names pairs (small, large) for a likelihood ratio.

    All must have the same flights. `how` goes to `fit`.
    """
    tell = progress or (lambda _: None)
    found: dict[str, Candidate] = {}
    for name, problem in problems.items():
        tell(f"comparing models: {name}")
        one = fit(problem, **how)
        values = {n: e.value for n, e in one.estimates.items()}
        found[name] = Candidate(
            name, one.status, one.log_likelihood, one.unknowns, one.aic, one.bic, one.white, values
        )
    tests = [_test(found[a], found[b]) for a, b in nested if a in found and b in found]
    ranked = tuple(sorted(found.values(), key=lambda c: (c.status == "not-converged", c.aic)))
    return Choice(ranked, tuple(tests), tuple(_sentences(ranked, tests)))


def _test(small: Candidate, large: Candidate) -> Nested:
    ratio = 2.0 * (large.log_likelihood - small.log_likelihood)
    degrees = max(large.unknowns - small.unknowns, 1)
    p = float(scipy.special.chdtrc(degrees, max(ratio, 0.0)))
    return Nested(small.name, large.name, ratio, degrees, p)


def _sentences(ranked: tuple[Candidate, ...], tests: list[Nested]) -> list[str]:
    settled = [c for c in ranked if c.status != "not-converged"]
    said = []
    if settled:
        first, by_bic = settled[0], min(settled, key=lambda c: c.bic)
        if first.name == by_bic.name:
            said.append(f"AIC and BIC prefer: {first.name}.")
        else:
            said.append(f"AIC prefers: {first.name}; BIC, which asks more of it: {by_bic.name}.")
        close = [c.name for c in settled[1:] if c.aic - first.aic < 2.0]
        if close:
            said.append(f"Hardly worse (AIC within 2): {', '.join(close)}.")
        if not first.white:
            said.append("Not even the preferred one leaves white residuals: something is missing.")
    failed = [c.name for c in ranked if c.status == "not-converged"]
    if failed:
        said.append(f"Did not converge, so not judged: {', '.join(failed)}.")
    said += [
        f"{t.small} within {t.large}: twice the log-likelihood gained is {t.ratio:.3g} for "
        f"{t.degrees} more unknown{'s' if t.degrees > 1 else ''} (p {_shown(t.p_value)})."
        for t in tests
        if not {t.small, t.large} & set(failed)
    ]
    return said


def _shown(p: float) -> str:
    return f"{p:.2g}" if p >= 1e-6 else "below 1e-6"
