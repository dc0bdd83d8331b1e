"""Model selection: likelihood, information criteria and nested tests of candidate models."""

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
from heli_jax.identification.problem import Problem
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
    """True if its residuals or innovations are white."""
    estimates: dict[str, float]


class Nested(NamedTuple):
    """Likelihood-ratio test of nested models."""

    small: str
    large: str
    ratio: float
    """Twice the gain in log-likelihood."""
    degrees: int
    """Number of added unknowns."""
    p_value: float
    """p-value of the smaller model; too large (conservative) if an unknown is at a bound (sigma_w,
    kappa >= 0)."""


class Choice(NamedTuple):
    """All candidates, best AIC first, and the nested tests."""

    candidates: tuple[Candidate, ...]
    nested: tuple[Nested, ...]
    sentences: tuple[str, ...]


class Alternatives(NamedTuple):
    """Problems by name, and pairs of nested ones (small, large)."""

    problems: dict[str, Problem]
    nested: tuple[tuple[str, str], ...]


class _Form(NamedTuple):
    """Assumptions of a candidate."""

    axes: tuple[str, ...]
    """Disturbed axes or states."""
    poles: int


def alternatives(
    problem: Problem,
    model: Model,
    names: Sequence[str],
    *,
    stated: Sequence[str] = (),
) -> Alternatives:
    """List candidates for filter error: no disturbance, one and two poles on the named axes, and
    with several axes each one left out.

    Args:
        problem: its settings of disturbances (starts, fixed values) apply to all candidates that
            have them.
        model: the model without disturbance.
        names: axes or states that may be disturbed.
        stated: the disturbances of a configuration, which form a candidate of their own.

    Raises:
        ValueError: one of the names cannot be disturbed.
    """
    names = tuple(names)
    one, two = "one pole", "two poles"
    forms = {"no disturbance": _Form((), 0)}
    if len(names) > 1:
        one, two = (f"all: {', '.join(names)}{end}" for end in ("", "; two poles"))
        for name in names:
            rest = tuple(n for n in names if n != name)
            forms[f"without {name}: {', '.join(rest)}"] = _Form(rest, 1)
        if 0 < len(stated) < len(names) - 1:
            forms[f"only {', '.join(stated)}"] = _Form(tuple(stated), 1)
    forms |= {one: _Form(names, 1), two: _Form(names, 2)}
    problems = {
        name: _by_filter_error(problem, model, form.axes or names[:1], form.poles)
        for name, form in forms.items()
    }
    # One pole is not nested in two, because both poles have the same time constant.
    pairs = [
        (small, large)
        for small, a in forms.items()
        for large, b in forms.items()
        if set(a.axes) < set(b.axes) and a.poles in (0, b.poles)
    ]
    return Alternatives(problems, tuple(pairs))


def _by_filter_error(problem: Problem, model: Model, on: Sequence[str], poles: int) -> Problem:
    """Return the problem for filter error with disturbances.

    Without poles one disturbance is fixed at almost zero, so that likelihoods are comparable.
    """
    model = with_disturbance(model, on, max(poles, 1))
    vehicle = naming.asdict(problem.vehicle)
    own = {n for d in disturbances_of(model) for n in (d.sigma, d.tau)}
    known = {n: vehicle[n] for n in naming.names(model.Params) if n in vehicle and n not in own}
    if not poles:
        [d] = disturbances_of(model)
        # A billionth of the motion replaces zero, which has no logarithm.
        known |= {d.sigma: jnp.asarray(1e-9 * problem.motion), d.tau: jnp.asarray(1.0)}
        fixed = (d.sigma, d.tau)
    else:
        # The stated start of a disturbance applies in every candidate that has it.
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


def choose(
    problems: Mapping[str, Problem],
    nested: Sequence[tuple[str, str]] = (),
    *,
    progress: Callable[[str], None] | None = None,
    **fit_options: Any,  # keywords of `fit`
) -> Choice:
    """Fit all problems and compare them.

    Args:
        nested: pairs of names (small, large) for likelihood-ratio tests.
        progress: called with a line of text before each fit.
        fit_options: passed to `fit`.

    Raises:
        ValueError: a candidate is estimated by instrument.
    """
    for name, problem in problems.items():
        # Fits of responses by instrument do have a likelihood, that of the response errors.
        responses = objective_of(problem.method).fits_responses
        if problem.noise_model == "spectrum" and not responses and instruments_of(problem):
            raise ValueError(
                f"{name}: an estimate by instrument has no likelihood for a comparison, expected "
                "instrument=() or method='filter-error'"
            )
    report = progress or (lambda _: None)
    fits: dict[str, Fit] = {}
    for name, problem in problems.items():
        report(f"comparing models: {name}")
        fits[name] = fit(problem, **fit_options)
    pairs = [(a, b) for a, b in nested if a in fits and b in fits]
    candidates = {}
    for name, f in fits.items():
        values = {n: e.value for n, e in f.estimates.items()}
        criteria = f.log_likelihood, f.unknowns, f.aic, f.bic
        candidates[name] = Candidate(name, f.status, *criteria, f.white, values)
    compared = [_test(candidates[a], candidates[b]) for a, b in pairs]
    # AIC is rounded because a vanished disturbance makes two models equal. The first then counts.
    ranked = tuple(
        sorted(candidates.values(), key=lambda c: (c.status == "not-converged", round(c.aic, 1)))
    )
    sentences = _sentences(ranked, compared)
    return Choice(ranked, tuple(t for t in compared if t.degrees > 0), tuple(sentences))


_BELOW = 0.05
"""Log-likelihood by which a model may fall below a nested one, due to convergence."""


def same_parameters(model: Model, other: Model) -> dict[str, str]:
    """Return the names of the same disturbance parameters in another model.

    A single disturbance has sigma_w; one of several has sigma_w_p.
    """
    by_state = {d.state: d for d in disturbances_of(other)}
    pairs = [(d, by_state[d.state]) for d in disturbances_of(model) if d.state in by_state]
    return {n: m for d, o in pairs for n, m in ((d.sigma, o.sigma), (d.tau, o.tau))}


def _test(small: Candidate, large: Candidate) -> Nested:
    """Test by Wilks' theorem; without added unknowns there is no p-value."""
    ratio = 2.0 * (large.log_likelihood - small.log_likelihood)
    degrees = large.unknowns - small.unknowns
    p = float(scipy.special.chdtrc(degrees, max(ratio, 0.0))) if degrees > 0 else float("nan")
    return Nested(small.name, large.name, ratio, degrees, p)


def _sentences(ranked: tuple[Candidate, ...], compared: list[Nested]) -> list[str]:
    converged = [c for c in ranked if c.status != "not-converged"]
    sentences = []
    if converged:
        first, by_bic = converged[0], min(converged, key=lambda c: c.bic)
        both = f"AIC and BIC prefer: {first.name}."
        apart = f"AIC prefers {first.name}; BIC, which is stricter, prefers {by_bic.name}."
        sentences.append(both if first.name == by_bic.name else apart)
        # Burnham and Anderson (2002): models within 2 of the best have substantial support.
        if close := [c.name for c in converged[1:] if c.aic - first.aic < 2.0]:
            sentences.append(f"Hardly worse (AIC within 2): {', '.join(close)}.")
        if not first.white:
            sentences.append(
                "Even the preferred one leaves coloured residuals: the model lacks something."
            )
    failed = [c.name for c in ranked if c.status == "not-converged"]
    if failed:
        sentences.append(f"Did not converge, hence not compared: {', '.join(failed)}.")
    sentences += [
        f"{t.large} ends below {t.small}, which is nested in it: its optimum was not found."
        for t in compared
        if t.ratio < -2.0 * _BELOW
    ]
    sentences += [
        f"{t.small} within {t.large}: gain in twice the log-likelihood {t.ratio:.3g} for "
        f"{t.degrees} more unknown{'s' if t.degrees > 1 else ''} (p {p_value(t.p_value)})."
        for t in compared
        if t.degrees > 0 and t.ratio >= -2.0 * _BELOW and not {t.small, t.large} & set(failed)
    ]
    return sentences + [
        f"{t.small} within {t.large}: the larger one has no more unknowns, so there is no test."
        for t in compared
        if t.degrees <= 0
    ]


def other_axes(model: Model, names: Sequence[str]) -> tuple[str, ...]:
    """Return the named axes and states, then the model's other axes."""
    rest = [axis.name for axis in axes_of(model) if not {axis.name, axis.rate} & set(names)]
    return (*names, *rest)


APART = 2.0
"""Joint standard deviations above which two estimates differ."""


class MethodResult(NamedTuple):
    """Result of one method."""

    method: str
    fit: Fit | None
    """None if the method refuses the problem."""
    reason: str
    """Reason for a missing result, else empty."""
    seconds: float

    @property
    def label(self) -> str:
        """Name of the method in reports."""
        return METHODS[self.method].label

    @property
    def word(self) -> str:
        """Verdict in a few words."""
        fit = self.fit
        if fit is None:
            return "refused"
        if fit.status == "not-converged":
            return "not converged"
        verdicts = {
            "not identifiable": fit.status != "converged",
            "not adequate": not fit.adequate,
            "intervals too narrow": fit.overconfident,
            f"{', '.join(fit.untrusted)} not trusted": fit.untrusted,
        }
        return ", ".join(word for word, holds in verdicts.items() if holds) or "converged, adequate"


class MethodComparison(NamedTuple):
    """Estimates of several methods; the first is the fit's own."""

    results: tuple[MethodResult, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names compared: free parameters, and free delays and input gains."""
        main = self.results[0].fit
        if main is None:
            return ()
        nuisances = (n for n in main.nuisance if n == "time_shift" or n.startswith("gain "))
        return (*main.estimates, *nuisances)

    def estimate(self, result: MethodResult, name: str) -> Estimate | None:
        """Return a method's estimate of a parameter, delay or gain; None without one."""
        if result.fit is None or result.reason:
            return None
        return {**result.fit.nuisance, **result.fit.estimates}.get(name)

    def difference(self, other: MethodResult, name: str) -> float | None:
        """Return an estimate less the main method's, in their joint standard deviations.

        They are treated as independent; estimates from the same records differ by less.
        """
        a, b = self.estimate(self.results[0], name), self.estimate(other, name)
        if a is None or b is None:
            return None
        if a.sd is None or b.sd is None or a.sd == b.sd == 0.0:
            return None
        return (b.value - a.value) / math.hypot(a.sd, b.sd)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on agreement and differences."""
        main, *others = self.results
        remarks = [f"{r.label} has no numbers: {r.reason}" for r in self.results if r.reason]
        if main.fit is None:
            return tuple(remarks)
        for other in others:
            differences = {n: self.difference(other, n) for n in self.names}
            known = {n: d for n, d in differences.items() if d is not None}
            apart = [f"{n} by {abs(d):.1f}" for n, d in known.items() if abs(d) > APART]
            if apart:
                remarks.append(
                    f"{other.label} and {main.label} differ in {', '.join(apart)} joint standard "
                    "deviations: an assumption of one of them is violated in this record."
                )
            elif known:
                remarks.append(
                    f"{other.label} and {main.label} agree within {APART:g} joint standard "
                    f"deviations in {', '.join(known)}."
                )
        return tuple(remarks)


def compare_methods(
    main: Fit,
    others: Mapping[str, Problem | str],
    *,
    progress: Callable[[str], None],
    **fit_options: Any,
) -> MethodComparison:
    """Fit a problem by further methods.

    Args:
        others: by method the problem, or the reason why the method refuses it.
        progress: called with a line of text before each fit.
        fit_options: passed to `fit`.
    """
    results = [MethodResult(main.method, main, _why_none(main), main.timing.get("fit", 0.0))]
    for method, problem in others.items():
        if isinstance(problem, str):
            results.append(MethodResult(method, None, problem, 0.0))
            continue
        progress(f"the same by {METHODS[method].label}")
        began = time.perf_counter()
        try:
            estimate = fit(problem, **fit_options)
            result = MethodResult(method, estimate, _why_none(estimate), 0.0)
        except ValueError as e:  # a failed method must not stop the others
            result = MethodResult(method, None, str(e), 0.0)
        results.append(result._replace(seconds=time.perf_counter() - began))
    return MethodComparison(tuple(results))


def _why_none(fit: Fit) -> str:
    if fit.status != "not-converged":
        return ""
    stopped = [f.sentence for f in fit.findings if f.code == STOPPED]
    return stopped[0] if stopped else "it did not converge"
