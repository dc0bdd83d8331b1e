"""Four intervals of one parameter side by side, and which to believe where they differ."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.bootstrap import Bootstrap, bootstrap
from heli_jax.identification.uncertainty.nuts import EFFECTIVE, RHAT, Posterior, nuts
from heli_jax.identification.uncertainty.profile_likelihood import Profile, profile

DIFFERENT = 0.15
"""intervals whose ends lie further apart than this part of their width differ"""


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
        profiles: parameters to profile; none unless given.
        runs: records of the bootstrap, 0 for none.
        draws: draws of each of four NUTS chains, 0 for none (needs the extra `bayes`).
        progress: told in words what is going on.

    Where the fit did not converge or the data leave a parameter open, there are none of these,
    and a sentence says so.

    Raises:
        ValueError: a parameter that is not free, or a missing extra.
    """
    tell = progress or (lambda _: None)
    lines, booted, posterior = {}, None, None
    missing = [n for n in profiles or () if n not in fit.estimates]
    if missing:
        raise ValueError(f"profile: expected one of {', '.join(fit.estimates)}, got {missing[0]}")
    said: list[str] = []
    if fit.status != "converged" and (profiles or runs or draws):
        why = "the fit did not converge"
        if fit.not_identifiable:
            why = f"the data do not determine {', '.join(fit.not_identifiable)}"
        said = [f"No further intervals: {why}."]
        profiles, runs, draws = None, 0, 0
    if profiles:
        tell(f"profile likelihood of {', '.join(profiles)}")
        lines = profile(fit, profiles)
    if runs:
        tell(f"bootstrap, {runs} records")
        booted = bootstrap(fit, runs, seed=seed)
    if draws:
        tell(f"NUTS, 4 chains of {draws} draws")
        posterior = nuts(fit, draws, seed=seed)
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for name, one in fit.estimates.items():
        if one.lower95 is None or one.upper95 is None:
            continue
        found[name] = {"gaussian": (one.lower95, one.upper95)}
        if name in lines:
            found[name]["profile"] = (lines[name].lower95, lines[name].upper95)
        if booted is not None and booted.values[name].size > 1:
            found[name]["bootstrap"] = booted.interval(name)
        if posterior is not None:
            found[name]["nuts"] = posterior.interval(name)
    said += _sentences(fit, found, booted, posterior)
    return Intervals(found, lines, booted, posterior, tuple(said))


def apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    """The larger distance between the ends of two intervals, over the width of the first."""
    ends = np.abs(np.array(one) - np.array(other))
    return float(np.max(ends) / abs(one[1] - one[0])) if np.isfinite(ends).all() else np.inf


def _sentences(
    fit: Fit,
    found: dict[str, dict[str, tuple[float, float]]],
    booted: Bootstrap | None,
    posterior: Posterior | None,
) -> list[str]:
    said = []
    if fit.coloured and any({"profile", "nuts"} & set(by) for by in found.values()):
        # Only what can be had: no bootstrap with a free time shift, no filter without an axis.
        bootstrap_too = booted is not None or not fit.reached.layout.shift
        said.append(
            "The residuals are coloured: profile and NUTS take them for white and are too narrow. "
            "Believe the Gaussian interval, which allows for their memory"
            + (", or the bootstrap, which draws noise of their spectrum" if bootstrap_too else "")
            + ("; or fit by filter error." if fit.disturbable else ".")
        )
    if booted is not None and booted.failures:
        said.append(
            f"{booted.failures} of the bootstrap's records could not be fitted and are left out: "
            "its intervals are too narrow by what those would have said."
        )
    if posterior is not None and not posterior.trusted:
        said.append(
            "The NUTS chains are not to be trusted (R-hat, effective draws, divergent steps: "
            f"expected below {RHAT}, above {EFFECTIVE} and none, got {posterior.rhat:.3f}, "
            f"{posterior.effective:.0f} and {posterior.divergent}): take more draws."
        )
    for name, by in found.items():
        others = {m: i for m, i in by.items() if m != "gaussian"}
        far = [m for m, i in others.items() if apart(by["gaussian"], i) > DIFFERENT]
        if far and not fit.coloured:
            said.append(f"{name}: {_which(far, others, booted, posterior)}")
    return said


def _which(
    far: list[str],
    others: dict[str, tuple[float, float]],
    booted: Bootstrap | None,
    posterior: Posterior | None,
) -> str:
    """Which interval to believe where some differ from the Gaussian one."""
    names = " and ".join(far)
    verb = "differ" if len(far) > 1 else "differs"
    text = f"{names} {verb} from the Gaussian interval by more than {DIFFERENT:.0%} of its width. "
    profiled = others.get("profile")
    if profiled is not None and not np.isfinite(profiled).all():
        return text + (
            "The likelihood has no end within nine standard deviations: the data bound it to one "
            "side at most, and no interval says more."
        )
    if len(far) == len(others):
        best = "profile" if profiled is not None else far[0]
        return text + (
            f"The likelihood is no parabola here (few samples, strong correlation or a bound): "
            f"believe the {best}."
        )
    if far == ["bootstrap"]:
        return text + (
            "The estimate scatters differently from what the curvature says (few samples, or a "
            "bias of the method): believe the bootstrap."
            if booted is not None and not booted.failures
            else "Records that could not be fitted are missing from it: believe the others."
        )
    if far == ["nuts"]:
        fine = posterior is not None and posterior.trusted
        return text + (
            "The prior, flat in the logarithm, or the noise's own uncertainty is felt: NUTS is "
            "right if that prior is meant."
            if fine
            else "Its chains have not settled: believe the others."
        )
    return text + "Believe the profile, which follows the likelihood itself."
