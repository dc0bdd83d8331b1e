"""The words under the report's figures, and those for who does not see them."""

from collections.abc import Mapping

import numpy as np

from heli_jax.identification.result import Fit
from heli_jax.numbers import measured, number, percent, vaf_percent
from heli_jax.report.drawings import Analysis
from heli_jax.report.figures.samples import MOST, share_within
from heli_jax.report.pictures import Picture

_MOST = 6
"""correlations that are told one by one"""
_CAPTIONS = {
    "response": "From above, over time: measured and simulated, what is left between them, inputs.",
    "residual": "From above, by lag: its correlation with itself, then with each input; of white "
    "noise 99 % of the lags lie within the band.",
    "bode": "Magnitude and phase of the fitted model, and of the record where its coherence "
    "allows.",
    "match": "From above: gain and phase of model and data with 95 % intervals, partial coherence "
    "of the data, and data over model. Grey: envelopes of what pilots of full-size aeroplanes "
    "did not notice (Wood and Hodgkinson, 1980).",
    "held": "The same of all flights held out together: gain and phase of model and data with 95 % "
    "intervals, partial coherence of the data, and data over model.",
    "correlation": "Near +1 or -1 the data hardly tell two parameters apart.",
    "starts": "The misfit that each start of the optimiser reached, best first.",
    "rls": "Each coefficient while the record goes by: one to be trusted settles.",
    "intervals": "Of each parameter, by every method; the dotted line is the estimate.",
    "trace": "Each colour is a chain. Chains to be trusted cannot be told apart and do not drift.",
    "pairs": "Dots and bars: the samples. Blue: the fit's Gaussian approximation with its "
    "intervals' sd; 95 % of it lie within a curve. Where the dots do not follow it, neither do "
    "intervals and correlations.",
}
"""by group, what a figure shows, after its title"""
_BODE_RLS = (
    "Magnitude and phase of the fitted model, of the recursive least squares, and of the record "
    "where its coherence allows."
)
GROUPS = tuple(_CAPTIONS)
# The template asks for figures by what their names begin with: no group may begin another's name.


def caption(picture: Picture, *, rls: bool) -> str:
    """What a figure shows, and the name of its files.

    Args:
        picture: as it was drawn.
        rls: whether recursive least squares were asked for.
    """
    [words] = [w for group, w in _CAPTIONS.items() if picture.name.startswith(group)]
    if rls and picture.name.startswith("bode"):
        words = _BODE_RLS
    return f"{picture.title}. {words} (figures/{picture.name}.svg)"


def alt_text(picture: Picture, analysis: Analysis) -> str:
    """What a figure of the report shows.

    Args:
        picture: as it was drawn.
        analysis: the fit and what belongs to it.
    """
    fit, intervals = analysis.fit, analysis.supplementary.intervals
    if picture.name == "correlation":
        return f"{picture.title}. {_correlations(fit)}."
    if picture.name == "starts":
        costs = [row.cost for row in fit.starts if row.converged]
        failed = len(fit.starts) - len(costs)
        best = f"; costs {_between(costs)}" if costs else ""
        return f"{picture.title}. Of {len(fit.starts)} starts {failed} failed{best}."
    if picture.name == "intervals" and intervals is not None:
        words = [
            f"{name} by {method} {number(low)} to {number(high)}"
            for name, methods in intervals.by_parameter.items()
            for method, (low, high) in methods.items()
        ]
        return f"{picture.title}. 95 % intervals: {'; '.join(words)}."
    if picture.name == "trace" or picture.name.startswith("pairs"):
        return f"{picture.title}. {_sampled(picture.name, analysis)}."
    for output, m in fit.metrics.items():
        if picture.name.startswith("response") and picture.name.endswith(f"_{output}"):
            return f"{picture.alt} Over the fitted flights: VAF {vaf_percent(m.vaf)}."
    return picture.alt


def _sampled(name: str, analysis: Analysis) -> str:
    """What the figures of draws and bootstrap show."""
    comparison, fit = analysis.supplementary.intervals, analysis.fit
    assert comparison is not None
    posterior, booted = comparison.posterior, comparison.bootstrap
    if name == "trace" and posterior is not None:
        each = (f"{n} {_scatter(v, fit, n)}" for n, v in list(posterior.draws.items())[:MOST])
        chains, draws = next(iter(posterior.draws.values())).shape
        return (
            f"{chains} chains of {draws} draws, {posterior.divergent} divergent; "
            f"mean and sd of all: {'; '.join(each)}"
        )
    samples: Mapping[str, np.ndarray] = {}
    if name == "pairs_posterior" and posterior is not None:
        samples = posterior.draws
    elif booted is not None:
        samples = booted.values
    names = list(samples)[:MOST]
    each = "; ".join(f"{n} {_scatter(samples[n], fit, n)}" for n in names)
    pairs = [(names[j], names[i]) for i in range(len(names)) for j in range(i)]
    shares = [(p, s) for p in pairs if (s := share_within(fit, samples, *p)) is not None]
    # What is furthest from the 95 % that the curve stands for is told first.
    worst = sorted(shares, key=lambda s: -abs(s[1] - 0.95))[:_MOST]
    inside = ", ".join(f"{x} and {y} {percent(share, 0)}" for (x, y), share in worst)
    count = next(iter(samples.values())).size
    within = f". Within the Gaussian 95 % curve: {inside}" if inside else ""
    return f"{count} samples, mean and sd: {each}{within}"


def _scatter(values: np.ndarray, fit: Fit, name: str) -> str:
    mean, sd = measured(float(np.std(values)), float(np.mean(values)))
    return f"{mean}, {sd} {fit.estimates[name].unit}".rstrip()


def _correlations(fit: Fit) -> str:
    names, correlation = fit.verdict.names, fit.verdict.correlation
    pairs = [(i, j) for i in range(len(names)) for j in range(i)]
    known = [(i, j) for i, j in pairs if np.isfinite(correlation[i, j])]
    largest = sorted(known, key=lambda p: -abs(correlation[p]))[:_MOST]
    words = (f"{names[j]} and {names[i]} {number(float(correlation[i, j]), 3)}" for i, j in largest)
    return f"Largest: {', '.join(words)}"


def _between(values: list[float]) -> str:
    low, high = number(min(values), 4), number(max(values), 4)
    return low if low == high else f"{low} to {high}"
