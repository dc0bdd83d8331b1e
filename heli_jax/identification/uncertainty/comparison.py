"""Intervals of a parameter by four methods, and findings on their differences."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from heli_jax.errors import require_kind
from heli_jax.finding import Finding, found, sentences
from heli_jax.identification.identifiability.profile import Profile, profile
from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.bootstrap import Bootstrap, bootstrap
from heli_jax.identification.uncertainty.nuts import EFFECTIVE, RHAT, Posterior, nuts
from heli_jax.stages import stage

DIFFERENT = 0.15
"""largest distance between the ends of equal intervals, over their width"""
_OF_QUANTILES = 2.0
"""the same for n samples of a bootstrap, times sqrt(n): three sd of a normal sample's 2.5 %
quantile, sqrt(0.025 0.975) / 0.0584, over 3.92"""

type _Ends = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Intervals:
    """95 % intervals by parameter and method, and their sources."""

    by_parameter: dict[str, dict[str, tuple[float, float]]]
    """parameter -> method ('gaussian', 'profile', 'bootstrap', 'nuts') -> (lower, upper)"""
    profiles: dict[str, Profile] = field(default_factory=dict)
    bootstrap: Bootstrap | None = None
    posterior: Posterior | None = None
    findings: tuple[Finding, ...] = ()

    @property
    def sentences(self) -> tuple[str, ...]:
        """The findings in words."""
        return tuple(sentences(self.findings))


def intervals(
    fit: Fit,
    *,
    profiles: Sequence[str] | None = None,
    runs: int = 0,
    draws: int = 0,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Intervals:
    """Return intervals by profile likelihood, bootstrap and NUTS beside the Gaussian ones of a fit.

    A fit that is not converged and identifiable has only Gaussian intervals.

    Args:
        profiles: parameters to profile.
        runs: records of the bootstrap, 0 for none.
        draws: draws of each of four NUTS chains, 0 for none (needs the extra `bayes`).
        progress: called with a line of text before each longer part of the work.

    Raises:
        ValueError: a parameter that is not free, or a missing extra.
        TypeError: `fit` is no Fit.
    """
    require_kind("fit", fit, Fit, "a Fit from heli_jax.fit(problem)")
    report = progress or (lambda _: None)
    profiled, booted, posterior, findings = {}, None, None, []
    missing = [n for n in profiles or () if n not in fit.estimates]
    if missing:
        raise ValueError(f"profile: expected one of {', '.join(fit.estimates)}, got {missing[0]}")
    if fit.status != "converged" and (profiles or runs or draws):
        findings.append(found("intervals.none", "doubt", *fit.not_identifiable))
        profiles, runs, draws = None, 0, 0
    if profiles:
        report(f"profile likelihood of {', '.join(profiles)}")
        with stage(f"profile likelihood of {', '.join(profiles)}", name="profile likelihood"):
            profiled = {name: profile(fit.reached, name) for name in profiles}
    if runs:
        report(f"bootstrap, {runs} records")
        with stage("bootstrap", total=runs):
            booted = bootstrap(fit, runs, seed=seed)
    if draws:
        report(f"NUTS, 4 chains of {draws} draws")
        with stage("NUTS"):
            posterior = nuts(fit, draws, seed=seed)
    by_parameter: dict[str, dict[str, _Ends]] = {}
    for name, estimate in fit.estimates.items():
        if estimate.lower95 is None or estimate.upper95 is None:
            continue
        by_parameter[name] = {"gaussian": (estimate.lower95, estimate.upper95)}
        if name in profiled:
            by_parameter[name]["profile"] = (profiled[name].lower95, profiled[name].upper95)
        if booted is not None and booted.values[name].size > 1:
            by_parameter[name]["bootstrap"] = booted.interval(name)
        if posterior is not None:
            by_parameter[name]["nuts"] = posterior.interval(name)
    findings += _findings(fit, by_parameter, booted, posterior)
    return Intervals(by_parameter, profiled, booted, posterior, tuple(findings))


def apart(first: _Ends, second: _Ends) -> float:
    """Return the larger distance between the ends of two intervals, over the width of the first."""
    ends = np.abs(np.array(first) - np.array(second))
    return float(np.max(ends) / abs(first[1] - first[0])) if np.isfinite(ends).all() else np.inf


def _findings(
    fit: Fit,
    by_parameter: Mapping[str, Mapping[str, _Ends]],
    booted: Bootstrap | None,
    posterior: Posterior | None,
) -> list[Finding]:
    findings = []
    # Methods in frequency weigh by the noise's spectrum.
    white = fit.coloured and fit.reached.layout.noise_model != "spectrum"
    if white and any({"profile", "nuts"} & set(by) for by in by_parameter.values()):
        findings.append(found("intervals.residuals-coloured"))
    if booted is not None and booted.failures:
        findings.append(found("intervals.records-failed", value=booted.failures))
    if posterior is not None and not posterior.trusted:
        numbers = {"rhat": posterior.rhat, "draws": posterior.effective}
        limits = {"most_rhat": RHAT, "least_draws": EFFECTIVE}
        findings.append(found("intervals.chains", value=posterior.divergent, **numbers, **limits))
    # With coloured residuals they differ for that reason.
    for name, by in () if fit.coloured else by_parameter.items():
        sampled = 0 if booted is None else booted.values[name].size
        limits = {"bootstrap": max(DIFFERENT, _OF_QUANTILES / max(sampled, 1) ** 0.5)}
        others = {m: ends for m, ends in by.items() if m != "gaussian"}
        apart_by = {m: apart(by["gaussian"], ends) for m, ends in others.items()}
        if far := [m for m, d in apart_by.items() if d > limits.get(m, DIFFERENT)]:
            bounded = np.isfinite(others.get("profile", (0.0, 0.0))).all()
            code = "intervals.differ" if bounded else "intervals.unbounded"
            findings.append(found(code, "doubt", name, methods=far, limit=DIFFERENT))
    return findings
