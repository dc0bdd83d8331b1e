"""Model selection: likelihood, information criteria and nested tests of candidates in a table."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import scipy.special

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of, with_disturbance
from heli_jax.dynamics.model import Model, axes_of
from heli_jax.identification.diagnostics.search import STOPPED
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.fit import fit
from heli_jax.identification.methods import METHODS, objective_of
from heli_jax.identification.problem import Free, Problem
from heli_jax.identification.result import Estimate, Fit, Status
from heli_jax.numbers import p_value


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
    """List candidates by filter error: no disturbance, one pole and two poles on `axis`.

    Args:
        model: the model without disturbance.
        without_stand: the same vehicle without its stand, where that is in question too; it is
            fitted without the stand's kappa and zeta.
    """
    problems: dict[str, Problem] = {}
    nested = []
    vehicles = {"": (model, dict(problem.free))}
    if without_stand is not None:
        free = {n: f for n, f in problem.free.items() if n not in ("kappa", "zeta")}
        vehicles[", no stand"] = (without_stand, free)
    for ending, (vehicle, free) in vehicles.items():
        # Without the stand's own parameters nothing may be left to estimate.
        if not free:
            continue
        for words, poles in (("no disturbance", 0), ("one pole", 1), ("two poles", 2)):
            disturbed = with_disturbance(vehicle, axis, max(poles, 1))
            problems[words + ending] = _by_filter_error(
                replace(problem, free=free), disturbed, silent=not poles
            )
            # One pole is no special case of two: both of these have the same time constant.
            if poles:
                nested.append((f"no disturbance{ending}", words + ending))
            # Free flight is the stand without stiffness and damping, where these may go to zero.
            if ending and _stand_may_vanish(problem):
                nested.append((words + ending, words))
    return Alternatives(problems, tuple(nested))


def _by_filter_error(problem: Problem, model: Model, *, silent: bool = False) -> Problem:
    """The problem by filter error with a disturbed model, starts of disturbances as it has them.

    Args:
        problem: gives the vehicle's values, and the starts of the disturbances that it has too.
        silent: fix its one disturbance at all but nothing: the measurement noise is then laid out
            as in the others, and the likelihoods can be compared.
    """
    vehicle = naming.asdict(problem.vehicle)
    own = {n for d in disturbances_of(model) for n in (d.sigma, d.tau)}
    known = {n: vehicle[n] for n in naming.names(model.Params) if n in vehicle and n not in own}
    if silent:
        [d] = disturbances_of(model)
        # Not zero: the logarithm of a size is what the layout holds. A billionth of the motion
        # moves no digit of the likelihood.
        known |= {d.sigma: jnp.asarray(1e-9 * problem.motion), d.tau: jnp.asarray(1.0)}
        fixed = (d.sigma, d.tau)
    else:
        # Starts that were stated for a disturbance hold in every candidate that has it, whatever it
        # is called there: alone it has the plain names.
        same = same_parameters(model, problem.model)
        known |= {n: vehicle[m] for n, m in same.items()}
        fixed = tuple(n for n, m in same.items() if m in problem.fixed_noise)
    return replace(
        problem,
        model=model,
        vehicle=model.Params(**known),
        method="filter-error",
        instrument=None,
        fixed_noise=(*fixed, *(n for n in problem.fixed_noise if n == "sigma_y")),
    )


def _stand_may_vanish(problem: Problem) -> bool:
    """True if a stand without stiffness and damping is among those fitted: each of the two is free
    to reach zero, or zero already."""
    values = naming.asdict(problem.vehicle)
    for name in ("kappa", "zeta"):
        if name in problem.free:
            lower = problem.free[name].lower
            if lower is not None and lower > 0:
                return False
        elif any(f.known.get(name, values[name]) != 0.0 for f in problem.training):
            return False
    return True


def choose(
    problems: Mapping[str, Problem],
    nested: Sequence[tuple[str, str]] = (),
    *,
    progress: Callable[[str], None] | None = None,
    **fit_options: Any,  # the keywords of `fit`, whose types stand there
) -> Choice:
    """Fit every problem and compare.

    A model that ends below one nested in it is fitted again from there, and a sentence says so.

    Args:
        nested: names (small, large) of those to compare by a likelihood ratio.
        progress: called with a line of text before each fit.
        fit_options: go to `fit`.

    Raises:
        ValueError: a candidate is estimated by instrument.
    """
    for name, problem in problems.items():
        method = objective_of(problem.method)
        # Responses by instrument have the likelihood of their errors.
        if (
            method.noise_model == "spectrum"
            and not method.fits_responses
            and instruments_of(problem)
        ):
            raise ValueError(
                f"{name}: an estimate by instrument has no likelihood to be compared by, expected "
                "instrument=() or method='filter-error'"
            )
    report = progress or (lambda _: None)
    fits: dict[str, Fit] = {}
    for name, problem in problems.items():
        report(f"comparing models: {name}")
        # Every candidate by the same estimator and on the same samples, or their likelihoods would
        # not be those of one record.
        fits[name] = fit(problem, **fit_options)
    pairs = [(a, b) for a, b in nested if a in fits and b in fits]
    sentences = _none_below_its_part(problems, pairs, fits, report, fit_options)
    candidates = {name: _candidate(name, fits[name]) for name in fits}
    compared = [_test(candidates[a], candidates[b]) for a, b in pairs]
    tests = [t for t in compared if t.degrees > 0]
    # A fit that has not converged has a likelihood too, of no optimum: it comes last in any case.
    # Rounded, since a disturbance that does not show leaves the same model: the one named first.
    ranked = tuple(
        sorted(candidates.values(), key=lambda c: (c.status == "not-converged", round(c.aic, 1)))
    )
    sentences += _sentences(ranked, tests)
    sentences += [
        f"{t.small} within {t.large}: the larger one has no unknown more, so there is no test."
        for t in compared
        if t.degrees <= 0
    ]
    return Choice(ranked, tuple(tests), tuple(sentences))


def _candidate(name: str, fit: Fit) -> Candidate:
    values = {n: e.value for n, e in fit.estimates.items()}
    return Candidate(
        name, fit.status, fit.log_likelihood, fit.unknowns, fit.aic, fit.bic, fit.white, values
    )


_BELOW = 0.05
"""log-likelihood by which a model may end below one that is nested in it: the optimiser's rest"""
_FAR = 10.0
"""the same for one with the same parameters and another disturbance, which is not nested"""


def _none_below_its_part(
    problems: Mapping[str, Problem],
    nested: Sequence[tuple[str, str]],
    fits: dict[str, Fit],
    report: Callable[[str], None],
    fit_options: dict[str, Any],
) -> list[str]:
    """Fit again, from the better optimum, what ended below a model that is nested in it, or far
    below one that has the same parameters; `fits` is changed, and the words are returned."""
    sentences = []
    # At the parameters of the nested model the larger one has its likelihood: an optimum below it
    # is a local one, and a ratio of the two would be negative.
    for (a, b), least in [*((p, _BELOW) for p in nested), *((p, _FAR) for p in _alike(problems))]:
        before, other = fits[b].log_likelihood, fits[a].log_likelihood
        if not before < other - least:
            continue
        report(f"comparing models: {b} again, from {a}")
        try:
            again = fit(begun_from(problems[b], problems[a], fits[a]), **fit_options)
        # Another model may diverge at parameters that suit this one.
        except ValueError:  # the model is unstable there
            again = fits[b]
        if again.log_likelihood > before + least:
            fits[b] = again
        reached, part = fits[b].log_likelihood, (a, b) in nested
        where = (
            f"below {a}, which is nested in it"
            if part
            else f"far below {a}, which has the same parameters"
        )
        if reached > before:
            sentences.append(
                f"{b} first ended {where} (log-likelihood {before:.1f} for {other:.1f}): begun "
                f"anew from that optimum it reaches {reached:.1f}."
            )
        if part and reached < other - least:
            sentences.append(
                f"{b} ends {where} (log-likelihood {reached:.1f} for {other:.1f}), also when it "
                "begins there: its own optimum was not found, and its test means nothing."
            )
    return sentences


def _alike(problems: Mapping[str, Problem]) -> list[tuple[str, str]]:
    """Pairs of models with the same parameters and disturbances on the same states, which differ
    in their kind."""
    with_noise = [name for name, problem in problems.items() if problem.noise]

    def disturbed(name: str) -> set[str]:
        return {d.state for d in disturbances_of(problems[name].model)}

    # Neither is nested in the other, but a disturbance seldom moves parameters far.
    return [
        (a, b)
        for a in with_noise
        for b in with_noise
        if a != b and problems[a].free == problems[b].free and disturbed(a) == disturbed(b)
    ]


_ALL_BUT_NOTHING = 1e-3
"""part of its start at which a parameter begins that the nested model does not have"""


def begun_from(problem: Problem, nested: Problem, optimum: Fit) -> Problem:
    """The problem with its starts where the fit of another one ended, the disturbance's too.

    Args:
        nested: the other one; a parameter that is fixed there begins at its value there, one that
            its model does not have begins all but at zero.
        optimum: the fit of `nested`.
    """
    free = {}
    for name, parameter in problem.free.items():
        # Not at zero itself, which has no logarithm.
        value = _ALL_BUT_NOTHING * parameter.start
        if name in optimum.estimates:
            value = optimum.estimates[name].value
        elif nested.model.name == problem.model.name and getattr(nested.vehicle, name) != 0:
            value = float(getattr(nested.vehicle, name))
        free[name] = parameter._replace(start=_inside(parameter, value))
    # A disturbance that did not show ended at zero: this one then begins where it always does.
    noise = {
        n: jnp.asarray(optimum.nuisance[m].value)
        for n, m in same_parameters(problem.model, nested.model).items()
        if n in problem.noise and m in optimum.nuisance and optimum.nuisance[m].value > 0
    }
    return replace(problem, free=free, vehicle=naming.replace(problem.vehicle, **noise))


def same_parameters(model: Model, other: Model) -> dict[str, str]:
    """By the name of a disturbance's parameter that of the same one in another model, where one
    disturbance alone is called sigma_w and one of several sigma_w_p."""
    by_state = {d.state: d for d in disturbances_of(other)}
    pairs = [(d, by_state[d.state]) for d in disturbances_of(model) if d.state in by_state]
    return {n: m for d, o in pairs for n, m in ((d.sigma, o.sigma), (d.tau, o.tau))}


def _inside(free: Free, value: float) -> float:
    """The value, or the nearest that is well inside the bounds."""
    # An optimum may lie on a bound, where the coordinates of a bounded parameter are at infinity.
    low, high = free.lower, free.upper
    size = high - low if low is not None and high is not None else abs(value) or abs(free.start)
    if low is not None:
        value = max(value, low + 1e-3 * size)
    if high is not None:
        value = min(value, high - 1e-3 * size)
    return value


def _test(small: Candidate, large: Candidate) -> Nested:
    """Without a further unknown there is nothing to test: degrees of 0, and no p-value."""
    # Both at their own optimum over the same samples, or the ratio has no known distribution.
    ratio = 2.0 * (large.log_likelihood - small.log_likelihood)
    degrees = large.unknowns - small.unknowns
    # Wilks: chi-squared with as many degrees of freedom as there are unknowns more.
    p = float(scipy.special.chdtrc(degrees, max(ratio, 0.0))) if degrees > 0 else float("nan")
    return Nested(small.name, large.name, ratio, degrees, p)


def _sentences(ranked: tuple[Candidate, ...], tests: list[Nested]) -> list[str]:
    converged = [c for c in ranked if c.status != "not-converged"]
    sentences = []
    if converged:
        first, by_bic = converged[0], min(converged, key=lambda c: c.bic)
        if first.name == by_bic.name:
            sentences.append(f"AIC and BIC prefer: {first.name}.")
        else:
            sentences.append(
                f"AIC prefers: {first.name}; BIC, which asks more of it: {by_bic.name}."
            )
        # Burnham and Anderson (2002): within 2 of the best there is substantial support.
        close = [c.name for c in converged[1:] if c.aic - first.aic < 2.0]
        if close:
            sentences.append(f"Hardly worse (AIC within 2): {', '.join(close)}.")
        if not first.white:
            sentences.append(
                "Not even the preferred one leaves white residuals: something is missing."
            )
    failed = [c.name for c in ranked if c.status == "not-converged"]
    if failed:
        sentences.append(f"Did not converge, so not compared: {', '.join(failed)}.")
    sentences += [
        f"{t.small} within {t.large}: twice the log-likelihood gained is {t.ratio:.3g} for "
        f"{t.degrees} more unknown{'s' if t.degrees > 1 else ''} (p {p_value(t.p_value)})."
        for t in tests
        if not {t.small, t.large} & set(failed)
    ]
    return sentences


# Which axes are disturbed: candidate models with all of them, each left out, and none.


def undisturbed_too(model: Model, names: Sequence[str]) -> tuple[str, ...]:
    """The named axes and states, then the model's other axes."""
    axes = axes_of(model)
    rates = {axis.name: axis.rate for axis in axes}
    pushed = {rates.get(n, n) for n in names}
    return (*names, *(axis.name for axis in axes if axis.rate not in pushed))


def disturbed_sets(
    problem: Problem, model: Model, names: Sequence[str], stated: Sequence[str] = ()
) -> Alternatives:
    """List candidates by filter error: no disturbance, each one left out, all, and all with two
    poles.

    As many candidates as disturbances and three: of four there would be sixteen sets, of six 64.

    Args:
        problem: gives vehicle, flights, free parameters and nuisances; what it says of disturbances
            (starts, what is fixed) holds for the candidates that have them.
        model: the model without disturbance.
        names: two and more axes or states that may be disturbed.
        stated: those of a configuration, which are a candidate of their own.

    Raises:
        ValueError: one of them cannot be disturbed, or there are fewer than two.
    """
    if len(names) < 2:
        raise ValueError(f"expected two disturbances or more to choose from, got {len(names)}")
    listed = ", ".join(names)
    # A model with one disturbance, not the model without: the same objective, the same noise and so
    # a likelihood that can be set beside the others'.
    problems = {
        "no disturbance": _by_filter_error(problem, with_disturbance(model, names[0]), silent=True)
    }
    everything = f"all: {listed}"
    for name in names:
        rest = [n for n in names if n != name]
        disturbed = with_disturbance(model, rest)
        problems[f"without {name}: {', '.join(rest)}"] = _by_filter_error(problem, disturbed)
    if 0 < len(stated) < len(names) - 1:
        only = f"only {', '.join(stated)}"
        problems[only] = _by_filter_error(problem, with_disturbance(model, stated))
    # What is within all of them, with nothing of its own: only of such pairs does a likelihood
    # ratio have a known distribution.
    smaller = list(problems)[1:]
    problems[everything] = _by_filter_error(problem, with_disturbance(model, names))
    two = f"{everything}; two poles"
    problems[two] = _by_filter_error(problem, with_disturbance(model, names, 2))
    # Two poles are no extension of one: both have as many parameters, so the two are compared by
    # AIC and not by a test.
    nested = [("no disturbance", name) for name in (*smaller, everything, two)]
    nested += [(name, everything) for name in smaller]
    return Alternatives(problems, tuple(nested))


# One problem by several methods, their estimates side by side.


APART = 2.0
"""joint standard deviations from which on two estimates differ"""


class MethodResult(NamedTuple):
    """Result of one method."""

    method: str
    fit: Fit | None
    """None where the method refuses the problem"""
    reason: str
    """why there are no numbers; empty where there are"""
    seconds: float

    @property
    def label(self) -> str:
        """The method as reports call it."""
        return METHODS[self.method].label

    @property
    def word(self) -> str:
        """Verdicts in a few words."""
        if self.fit is None:
            return "refused"
        if self.fit.status == "not-converged":
            return "not converged"
        words = [] if self.fit.status == "converged" else ["not identifiable"]
        words += [] if self.fit.adequate else ["not adequate"]
        words += ["intervals too narrow"] if self.fit.overconfident else []
        doubted = self.fit.untrusted
        words += [f"{', '.join(doubted)} not trusted"] if doubted else []
        return ", ".join(words) or "converged, adequate"


class MethodComparison(NamedTuple):
    """Methods side by side; the first is the fit's own."""

    results: tuple[MethodResult, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names compared: the free parameters, and the delay and the gains of inputs that were free
        beside them."""
        main = self.results[0].fit
        if main is None:
            return ()
        beside = (n for n in main.nuisance if n == "time_shift" or n.startswith("gain "))
        return (*main.estimates, *beside)

    def estimate(self, result: MethodResult, name: str) -> Estimate | None:
        """A method's estimate; None where it has none.

        Args:
            name: of a parameter, delay or gain.
        """
        if result.fit is None or result.reason:
            return None
        return {**result.fit.nuisance, **result.fit.estimates}.get(name)

    def difference(self, other: MethodResult, name: str) -> float | None:
        """An estimate less the main method's, in their joint standard deviations.

        The two are taken as independent. Both come from the same records, so that they differ by
        less than this where both are right: a difference that it shows is one.
        """
        a, b = self.estimate(self.results[0], name), self.estimate(other, name)
        if a is None or b is None:
            return None
        if a.sd is None or b.sd is None or a.sd == b.sd == 0.0:
            return None
        return (b.value - a.value) / math.hypot(a.sd, b.sd)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on what agrees and what differs."""
        main, *others = self.results
        said = [f"{r.label} has no numbers: {r.reason}" for r in self.results if r.reason]
        if main.fit is None:
            return tuple(said)
        for other in others:
            differences = {n: self.difference(other, n) for n in self.names}
            known = {n: d for n, d in differences.items() if d is not None}
            apart = [f"{n} by {abs(d):.1f}" for n, d in known.items() if abs(d) > APART]
            if apart:
                said.append(
                    f"{other.label} and {main.label} differ in {', '.join(apart)} joint standard "
                    "deviations: what one of them takes for granted does not hold of this record."
                )
            elif known:
                said.append(
                    f"{other.label} and {main.label} agree within {APART:g} joint standard "
                    f"deviations in {', '.join(known)}."
                )
        return tuple(said)


def compare_methods(
    main: Fit,
    others: Mapping[str, Problem | str],
    *,
    starts: int | None = None,
    seed: int = 0,
    max_steps: int = 200,
    progress: Callable[[str], None] | None = None,
) -> MethodComparison:
    """Fit a problem by further methods.

    Args:
        others: by method the problem, or why the method refuses it.
        starts: as `fit` takes it.
        progress: called with a line of text before each longer part of the work.
    """
    report = progress or (lambda _: None)
    results = [MethodResult(main.method, main, _why_none(main), main.timing.get("fit", 0.0))]
    for method, problem in others.items():
        if isinstance(problem, str):
            results.append(MethodResult(method, None, problem, 0.0))
            continue
        report(f"the same by {METHODS[method].label}")
        began = time.perf_counter()
        try:
            estimate = fit(problem, starts=starts, seed=seed, max_steps=max_steps)
            result = MethodResult(method, estimate, _why_none(estimate), 0.0)
        except ValueError as e:  # one that fails must not cost the others
            result = MethodResult(method, None, str(e), 0.0)
        results.append(result._replace(seconds=time.perf_counter() - began))
    return MethodComparison(tuple(results))


def _why_none(fit: Fit) -> str:
    if fit.status != "not-converged":
        return ""
    stopped = [f.sentence for f in fit.findings if f.code == STOPPED]
    return stopped[0] if stopped else "it did not converge"
