"""Four intervals of one parameter side by side, and which to believe where they differ."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from heli_jax.errors import require_kind
from heli_jax.identification.identifiability.profile import Profile, profile
from heli_jax.identification.methods import objective_of
from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.bootstrap import Bootstrap, bootstrap
from heli_jax.identification.uncertainty.nuts import EFFECTIVE, RHAT, Posterior, nuts
from heli_jax.numbers import percent
from heli_jax.stages import stage

DIFFERENT = 0.15
"""intervals whose ends lie further apart than this part of their width differ"""
_OF_QUANTILES = 2.0
"""over the root of the number of samples, the same for the ends of a bootstrap: three standard
deviations of a normal sample's 2.5 % quantile, sqrt(0.025 0.975) / 0.0584 of its own, over 3.92"""


@dataclass(frozen=True, eq=False)
class Intervals:
    """95 % intervals by parameter and method, and what they came from."""

    by_parameter: dict[str, dict[str, tuple[float, float]]]
    """parameter -> method ('gaussian', 'profile', 'bootstrap', 'nuts') -> (lower, upper)"""
    profiles: dict[str, Profile] = field(default_factory=dict)
    bootstrap: Bootstrap | None = None
    posterior: Posterior | None = None
    sentences: tuple[str, ...] = ()


def intervals(
    fit: Fit,
    *,
    profiles: Sequence[str] | None = None,
    runs: int = 0,
    draws: int = 0,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Intervals:
    """Profile likelihood, bootstrap and posterior beside the Gaussian intervals of a fit.

    Args:
        fit: the result of `fit`.
        profiles: parameters to profile; none unless given.
        runs: records of the bootstrap, 0 for none.
        draws: draws of each of four NUTS chains, 0 for none (needs the extra `bayes`).
        seed: of bootstrap and chains.
        progress: called with a line of text before each longer part of the work.

    Where the fit did not converge or the data leave a parameter open, there are none of these,
    and a sentence says so.

    Raises:
        ValueError: a parameter that is not free, or a missing extra.
        TypeError: `fit` is no Fit.
    """
    require_kind("fit", fit, Fit, "a Fit, as heli_jax.fit(problem) returns it")
    report = progress or (lambda _: None)
    profiled, booted, posterior = {}, None, None
    missing = [n for n in profiles or () if n not in fit.estimates]
    if missing:
        raise ValueError(f"profile: expected one of {', '.join(fit.estimates)}, got {missing[0]}")
    sentences: list[str] = []
    # Without an optimum profiles and chains would wander off from where the optimiser stopped.
    if fit.status != "converged" and (profiles or runs or draws):
        why = "the fit did not converge"
        if fit.not_identifiable:
            why = f"the data do not determine {', '.join(fit.not_identifiable)}"
        sentences = [f"No further intervals: {why}."]
        profiles, runs, draws = None, 0, 0
    # From the quickest to the slowest, so that a mistake shows early.
    if profiles:
        report(f"profile likelihood of {', '.join(profiles)}")
        with stage(f"profile likelihood of {', '.join(profiles)}", name="profile likelihood"):
            profiled = {name: profile(fit.reached, name) for name in profiles}
    if runs:
        report(f"bootstrap, {runs} records")
        with stage("bootstrap", total=runs):
            booted = bootstrap(fit, runs, seed=seed)
        if booted.note:
            report(booted.note)
    if draws:
        report(f"NUTS, 4 chains of {draws} draws")
        with stage("NUTS"):
            posterior = nuts(fit, draws, seed=seed)
    by_parameter: dict[str, dict[str, tuple[float, float]]] = {}
    for name, estimate in fit.estimates.items():
        # Nothing of a parameter that is not identifiable.
        if estimate.lower95 is None or estimate.upper95 is None:
            continue
        by_parameter[name] = {"gaussian": (estimate.lower95, estimate.upper95)}
        if name in profiled:
            by_parameter[name]["profile"] = (profiled[name].lower95, profiled[name].upper95)
        # Percentiles of a single value would be an interval of no width.
        if booted is not None and booted.values[name].size > 1:
            by_parameter[name]["bootstrap"] = booted.interval(name)
        if posterior is not None:
            by_parameter[name]["nuts"] = posterior.interval(name)
    sentences += _sentences(fit, by_parameter, booted, posterior)
    return Intervals(by_parameter, profiled, booted, posterior, tuple(sentences))


def apart(first: tuple[float, float], second: tuple[float, float]) -> float:
    """The larger distance between the ends of two intervals, over the width of the first."""
    ends = np.abs(np.array(first) - np.array(second))
    return float(np.max(ends) / abs(first[1] - first[0])) if np.isfinite(ends).all() else np.inf


def _sentences(
    fit: Fit,
    by_parameter: dict[str, dict[str, tuple[float, float]]],
    booted: Bootstrap | None,
    posterior: Posterior | None,
) -> list[str]:
    sentences = []
    # In frequency both go by the noise's spectrum, as the intervals do.
    white = fit.coloured and objective_of(fit.method).noise_model != "spectrum"
    if white and any({"profile", "nuts"} & set(by) for by in by_parameter.values()):
        # Only what can be had: no bootstrap with a free time shift, no filter without an axis.
        bootstrap_too = booted is not None or not fit.reached.layout.shift
        sentences.append(
            "The residuals are coloured: profile and NUTS take them for white and are too narrow. "
            "Believe the Gaussian interval, which allows for their autocorrelation"
            + (", or the bootstrap, which draws noise of their spectrum" if bootstrap_too else "")
            + ("; or fit by filter error." if fit.disturbable else ".")
        )
    if booted is not None and booted.failures:
        sentences.append(
            f"{booted.failures} of the bootstrap's records could not be fitted and are left out: "
            "its intervals are too narrow by what those would have said."
        )
    beside = [n for n in fit.nuisance if n == "time_shift" or n.startswith("gain ")]
    if beside and booted is not None:
        sentences.append(
            f"Estimated in each record of the bootstrap too, without an interval of it here: "
            f"{', '.join(beside)}. The Gaussian one stands beside the parameters' estimates."
        )
    # The numbers with their limits: a reader can see whether a few more draws will do.
    if posterior is not None and not posterior.trusted:
        sentences.append(
            "The NUTS chains are not to be trusted (R-hat, effective draws, divergent steps: "
            f"expected below {RHAT}, above {EFFECTIVE} and none, got {posterior.rhat:.3f}, "
            f"{posterior.effective:.0f} and {posterior.divergent}): take more draws."
        )
    # With coloured residuals they differ for the reason that was given above.
    for name, by in () if fit.coloured else by_parameter.items():
        others = {method: ends for method, ends in by.items() if method != "gaussian"}
        far = []
        for method, ends in others.items():
            limit = DIFFERENT
            if method == "bootstrap" and booted is not None:
                limit = max(limit, _OF_QUANTILES / booted.values[name].size ** 0.5)
            if apart(by["gaussian"], ends) > limit:
                far.append(method)
        if far:
            sentences.append(f"{name}: {_which(far, others, booted, posterior)}")
    return sentences


def _which(
    far: list[str],
    others: dict[str, tuple[float, float]],
    booted: Bootstrap | None,
    posterior: Posterior | None,
) -> str:
    """Which interval to believe where some differ from the Gaussian one."""
    verb = "differ" if len(far) > 1 else "differs"
    by = f"by more than {percent(DIFFERENT, 0)} of its width"
    text = f"{' and '.join(far)} {verb} from the Gaussian interval {by}. "
    profiled = others.get("profile")
    if profiled is not None and not np.isfinite(profiled).all():
        why = (
            "It is practically not identifiable: within nine standard deviations the likelihood "
            "bounds it to one side at most, and no interval says more."
        )
    # All against the Gaussian one: it is the parabola that is wrong, not one of their assumptions.
    elif len(far) == len(others):
        why = (
            "The log-likelihood is not quadratic here (few samples, strong correlation or a "
            f"bound): believe the {'profile' if profiled is not None else far[0]}."
        )
    elif far == ["bootstrap"] and booted is not None and booted.failures:
        why = "Records that could not be fitted are missing from it: believe the others."
    elif far == ["bootstrap"]:
        why = (
            "The estimate scatters differently from what the curvature says (few samples, or a "
            "bias of the method): believe the bootstrap."
        )
    elif far == ["nuts"] and not (posterior is not None and posterior.trusted):
        why = "Its chains have not settled: believe the others."
    elif far == ["nuts"]:
        why = (
            "The prior, flat in the logarithm, or the noise's own uncertainty is felt: NUTS is "
            "right if that prior is meant."
        )
    else:
        why = "Believe the profile, which follows the likelihood itself."
    return text + why
