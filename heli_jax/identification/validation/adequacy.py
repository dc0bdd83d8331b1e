"""Whether the model is adequate: does it explain what was measured, beside noise and disturbance?

That an optimiser arrived and that the data determine the parameters says nothing of it: the best
parameters of a wrong model are found and determined as well as those of the right one.

What is judged is the simulated response of every fitted output. The acceptance card asks for a
variance accounted for (VAF) of 0.9 (Tischler and Remple, 2012, and Jategaonkar, 2006, gate fits of
flights in that region). A model is called inadequate only where it misses that by far: where it
leaves more than a fifth of what is not white noise unexplained, twice what the gate allows.
Between the two there is doubt, and the same advice. White
residuals are adequate whatever the VAF: then all that is left is measurement noise. With filter
error the simulation does not know the disturbance, so it is judged against what the estimated
disturbance lets expect.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from heli_jax.identification.estimation.noise_covariance import noise_guess
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.advice import (
    FAR_FROM_WHITE,
    Judged,
    Record,
    advice_for,
    is_unstable,
)
from heli_jax.identification.validation.metrics import (
    Metrics,
    Whiteness,
    autocorrelation,
)

EXPLAINED = 0.8
"""share of what is not white noise that has to be explained"""
NEARLY_WHITE = 0.1
"""share of the residual's variance that may be other than white noise where nothing else is left"""
WORSE = -0.1
"""VAF below which not even a white residual is taken for noise alone: in a short record of noise
chance makes it a few hundredths negative"""
EXPECTED = 9.0
"""power of the simulation's error over that which the disturbance lets expect: its square root is
three standard deviations where the disturbance is so slow that the record holds one swing of it"""
_TURNED = -3.0
"""slope of the measured on the simulated output that no disturbance makes"""
_FIVE_PERCENT = -1.645
"""of a standard normal distribution, to one side"""


class Adequacy(NamedTuple):
    """Whether a model is adequate, why not, and what to do."""

    adequate: bool
    less_than_mean: bool
    """whether some output is followed worse than by its mean"""
    judged: tuple[Judged, ...]
    reasons: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    """what looks bad and is as expected"""

    @property
    def doubtful(self) -> bool:
        """Whether some output misses the card's gate, though not by far."""
        return any(one.doubtful for one in self.judged)

    @property
    def summary(self) -> str:
        """`yes`, or `no (VAF of p is -586, less than its mean)`."""
        if self.adequate:
            doubts = [
                f"VAF of {one.output} is {one.vaf:.3g}" for one in self.judged if one.doubtful
            ]
            return f"yes, with doubts ({'; '.join(doubts)})" if doubts else "yes"
        bad = [one for one in self.judged if not one.adequate]
        words = [
            f"VAF of {one.output} is {one.vaf:.3g}{', less than its mean' if one.vaf < 0 else ''}"
            for one in bad
        ]
        return f"no ({'; '.join(words)})" if words else "no"

    @property
    def sentences(self) -> tuple[str, ...]:
        """For the notes of a fit."""
        return (*self.reasons, *self.advice, *self.remarks)


UNJUDGED = Adequacy(True, False, ())
"""what a Fit has that nobody judged"""


def assess(
    problem: Problem,
    params: Any,
    records: tuple[Record, ...],
    agreement: Mapping[str, Metrics],
    whiteness: Mapping[str, Whiteness],
    against: Mapping[str, float] | None = None,
    unknowns: int = 0,
) -> Adequacy:
    """Judge the fitted flights.

    Args:
        params: the vehicle with the estimates in place.
        records: the fitted flights.
        agreement: of the simulation, by output over all fitted flights.
        whiteness: by 'flight/output', of the residuals, with filter error of the innovations.
        against: with a disturbance, by output the power of the simulation's error over that which
            disturbance and noise make; without, the simulation has to explain by itself.
        unknowns: how many were estimated; a response that explains no more than as many unknowns
            explain of noise by chance shows nothing.
    """
    unstable = against is not None and is_unstable(problem, params)
    judged = tuple(
        _judged(name, m, records, whiteness, None if against is None else against[name], unstable)
        for name, m in agreement.items()
        if not _still(name, records)
    )
    bad = [one for one in judged if not one.adequate]
    if judged and not bad and against is None and not _stands_out(judged, records, unknowns):
        return _nothing_shown(judged)
    doubted = [*bad, *(one for one in judged if one.doubtful)]
    unstable = unstable or (bool(bad) and is_unstable(problem, params))
    apart = len(doubted) < len(judged)
    advice = [
        text for one in doubted for text in advice_for(problem, one, records, unstable, apart)
    ]
    remarks = [
        f"Driven by the inputs alone, the model follows {one.output} worse than its mean does (VAF "
        f"{one.vaf:.3g}), as the estimated disturbance lets expect. If none acted, are the "
        "columns, signs and units the right ones?"
        for one in judged
        if one.adequate and one.against_disturbance is not None and one.vaf < 0
    ]
    return Adequacy(
        not bad,
        any(not one.vaf >= 0 for one in bad),
        judged,
        tuple(_reason(one) for one in bad),
        tuple(dict.fromkeys(advice)),
        tuple(remarks),
    )


_BY_CHANCE = 1e-3
"""probability that noise alone is explained as well"""


def _stands_out(judged: tuple[Judged, ...], records: tuple[Record, ...], unknowns: int) -> bool:
    """Whether the response of some output stands out of the noise: a likelihood ratio of the model
    against a constant (Wilks, 1938)."""
    for one in judged:
        measured = [r.measured[one.output] for r in records if one.output in r.measured]
        n = sum(int(np.isfinite(y).sum()) for y in measured)
        gained = -n * np.log(max(1.0 - one.vaf, 1e-300))
        if unknowns < 1 or scipy.special.chdtrc(unknowns, max(gained, 0.0)) < _BY_CHANCE:
            return True
    return not judged


def _nothing_shown(judged: tuple[Judged, ...]) -> Adequacy:
    outputs = " and ".join(f"{one.output} (VAF {one.vaf:.2g})" for one in judged)
    return Adequacy(
        False,
        False,
        tuple(one._replace(adequate=False) for one in judged),
        (
            f"The response does not stand out of the noise in {outputs}: as many unknowns explain "
            "as much of noise alone.",
        ),
        ("Use larger or more inputs, a longer record, or an output with less noise.",),
    )


def _still(name: str, records: tuple[Record, ...]) -> bool:
    """Whether an output never moves: nothing is to be explained."""
    return all(np.nanstd(r.measured[name]) == 0 for r in records if name in r.measured)


def _judged(
    name: str,
    m: Metrics,
    records: tuple[Record, ...],
    whiteness: Mapping[str, Whiteness],
    against: float | None,
    unstable: bool,
) -> Judged:
    mine = [whiteness[f"{r.label}/{name}"] for r in records if name in r.measured]
    white = all(w.white for w in mine)
    lag1 = max((w.lag1 for w in mine), key=abs)
    error = [r.measured[name] - r.simulated[name] for r in records if name in r.measured]
    total = np.concatenate([r.measured[name] for r in records if name in r.measured])
    explained, other = _explained(np.concatenate(error), total, error)
    if not np.isfinite(m.vaf):
        return Judged(name, False, m.vaf, float("nan"), white, lag1, against)
    enough = explained >= EXPLAINED
    if against is None:
        noise_alone = (white or other <= NEARLY_WHITE) and m.vaf >= WORSE
        return Judged(name, bool(enough or noise_alone), m.vaf, explained, white, lag1)
    # Of an unstable model the filter expects any error of a simulation: then its innovations are
    # all there is to judge by.
    expected = against <= EXPECTED and (white or (abs(lag1) < FAR_FROM_WHITE and not unstable))
    expected = expected and not _moves_against(name, records)
    return Judged(name, bool(enough or expected), m.vaf, explained, white, lag1, against)


def _moves_against(name: str, records: tuple[Record, ...]) -> bool:
    """Whether the measured output goes against a simulated one that has shrunk, not by chance.

    A disturbance knows nothing of the inputs. So the slope of the measured on the simulated output
    is 1 but for what chance makes of the two, whose autocorrelations say how much that is
    (Bartlett, 1935). In a record of a few swings of the disturbance that is little known, and the
    slope may well be below zero. Where an input has the wrong sign and the parameters keep theirs,
    the filter takes the response for disturbance and the simulation shrinks: the slope is then
    several times below -1.
    """
    product, power, variance = 0.0, 0.0, 0.0
    for r in records:
        if name not in r.measured or not np.isfinite(r.simulated[name]).all():
            continue
        y, m = r.measured[name], r.simulated[name]
        d, m = np.where(np.isnan(y), 0.0, y - m - np.nanmean(y - m)), m - m.mean()
        lags = max(1, y.size // 5)
        window = 1.0 - np.arange(lags + 1) / (lags + 1)
        both = window * autocorrelation(d, lags) * autocorrelation(m, lags)
        product, power = product + float(d @ m), power + float(m @ m)
        variance += float(d @ d) * float(m @ m) * (both[0] + 2.0 * both[1:].sum()) / y.size
    if not (power > 0 and variance > 0):
        return False
    return 1.0 + product / power < _TURNED and product / variance**0.5 < _FIVE_PERCENT


def _explained(
    error: np.ndarray, measured: np.ndarray, by_flight: list[np.ndarray]
) -> tuple[float, float]:
    """Share explained of what is not white noise, and the part of the error that is not."""
    with np.errstate(all="ignore"):
        residual, total = float(np.nanvar(error)), float(np.nanvar(measured))
        sizes = [int(np.count_nonzero(~np.isnan(r))) for r in by_flight]
        noises = [noise_guess(r) ** 2 for r in by_flight]
        noise = float(np.average(noises, weights=sizes))
    if not np.isfinite(residual):
        return float("nan"), float("nan")
    other = max(residual - noise, 0.0)
    rest = max(total - min(noise, residual), 1e-300)
    return 1.0 - other / rest, other / residual if residual > 0 else 0.0


def _reason(one: Judged) -> str:
    if not np.isfinite(one.vaf):
        return f"The simulated {one.output} is not finite: nothing of it is explained."
    if one.vaf < 0:
        return (
            f"Driven by the inputs alone, the model follows {one.output} worse than its mean does "
            f"(VAF {one.vaf:.3g}): its parameters mean little. Are the columns, signs and units "
            "the right ones, and the start values near?"
        )
    if one.against_disturbance is not None and one.against_disturbance > EXPECTED:
        return (
            f"The simulated {one.output} misses the measured one by "
            f"{one.against_disturbance**0.5:.2g} times what the estimated disturbance explains "
            f"(VAF {one.vaf:.3g})."
        )
    if one.against_disturbance is not None:
        return (
            f"The innovations of {one.output} are far from white (autocorrelation {one.lag1:+.2f} "
            f"at one sample) and its simulation explains little (VAF {one.vaf:.3g})."
        )
    return (
        f"The model explains {one.explained:.0%} of what in {one.output} is not white noise (VAF "
        f"{one.vaf:.3g}), wanted is half at least; the acceptance card asks for a VAF of 0.9."
    )
