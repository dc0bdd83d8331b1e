"""Whether the inputs still explain what a fit leaves: dynamics that the model lacks.

The whiteness of residuals alone does not say why: a disturbance colours them as well. Dynamics that
are missing leave a residual that is a filtered input (Ljung, 1999, section 16.6), a disturbance
does not.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.special

from heli_jax.dynamics.kinematics import FORCES
from heli_jax.finding import Finding, note
from heli_jax.identification.validation.metrics import cross_correlation
from heli_jax.identification.validation.own_samples import own_samples
from heli_jax.numbers import percent

_SECONDS = 0.4
"""lags of an input that are looked at"""
_MOST_LAGS = 30
ORDER = 10
"""of the autoregression that whitens"""
_BY_CHANCE = 1e-5
"""probability, for all pairs of a fit together, at which nothing is said"""
_WORTH_IT = 0.02
"""share of the whitened residual below which it makes no difference to the estimates"""
_EARLIER = 0.6
"""part of the largest correlation with an earlier input that one with a later input reaches where
the clocks differ: a fit leaves what came early and what it expected late, both alike"""
_BY_CHANCE_AT_MOST = 5.0
"""correlation of independent signals, times the root of the samples"""
_FEWEST = 10
"""samples for each regressor"""
_OF_A_MACHINE = (
    "the model lacks dynamics between the two, which its estimates then stand for. Is a servo, a "
    "rate loop or a filter missing (onboard)? Or is this a poor optimum? Several starts "
    "(fit.starts) tell."
)
_OF_AN_ACCELERATION = " Is the sensor away from the centre of gravity (x_imu, y_imu, z_imu)?"
"""What turning adds to an accelerometer is an answer to the inputs too."""
_OF_SENSORS = (
    "bias, scale and delay do not account for it, and their estimates take up a part. Is one of "
    "the two filtered, or an estimator's and not a sensor's?"
)


class Left(NamedTuple):
    """What a fit leaves of one flight."""

    dt: float
    """[s]"""
    residuals: Mapping[str, np.ndarray]
    """by output (N,), NaN where nothing is measured; innovations with filter error"""
    inputs: Mapping[str, np.ndarray]
    """(N,)"""


class Explained(NamedTuple):
    """How much of a residual an input explains."""

    share: float
    """of the variance of the whitened residual"""
    p_value: float
    """of an F test"""
    lag: float
    """where the response to the input is largest [s]; negative where it comes before the input"""


def missing_dynamics(
    flights: tuple[Left, ...], *, sensors: bool = False, mentioned: bool = False
) -> list[Finding]:
    """Findings of what inputs still explain of the residuals.

    Args:
        flights: those that were fitted.
        sensors: whether inputs and outputs are sensors that are compared with each other, between
            which there are no dynamics; of each output the input that explains most is named.
        mentioned: whether it is said elsewhere already that dynamics are missing.
    """
    pairs = [(f, output, name) for f in flights for output in f.residuals for name in f.inputs]
    # By output and input over all flights, so that one missing servo is one sentence.
    explained: dict[tuple[str, str], Explained] = {}
    for flight, output, name in pairs:
        e, u, dt, holes = flight.residuals[output], flight.inputs[name], flight.dt, ()
        own = own_samples(np.isfinite(e))
        if own is not None and own.every > 1:
            e, u, dt, holes = e[own.rows], own.of_input(u), own.every * dt, own.holes
        one = explained_by(e, u, dt, by_chance=_BY_CHANCE / len(pairs), holes=holes)
        if one is None or one.share < _WORTH_IT:
            continue
        known = explained.get((output, name))
        if known is None or one.share > known.share:
            explained[output, name] = one
    if sensors:
        most = {
            output: max(e.share for (o, _), e in explained.items() if o == output)
            for output, _ in explained
        }
        explained = {pair: e for pair, e in explained.items() if e.share == most[pair[0]]}
    remedy = "" if mentioned else _OF_SENSORS if sensors else _OF_A_MACHINE
    findings = []
    for (output, name), one in explained.items():
        away = output in FORCES and not sensors
        words = _sentence(output, name, one, remedy + away * _OF_AN_ACCELERATION)
        code = "dynamics.residual-precedes-input" if one.lag < 0 else "dynamics.input-explains"
        criterion = f"part of the whitened residual, {_WORTH_IT:g}"
        findings.append(Finding(code, "note", words, one.share, criterion, (output, name)))
        # The remedy of all of them is the same: the first one says it.
        remedy = remedy if one.lag < 0 else ""
    gappy = {
        n: None
        for f in flights
        for n, r in f.residuals.items()
        if own_samples(np.isfinite(r)) is None
    }
    if gappy:
        words = f"Missing dynamics of {', '.join(gappy)} were not tested: samples are missing."
        findings.append(note("dynamics.not-tested", words, *gappy))
    return findings


def _sentence(output: str, name: str, one: Explained, remedy: str) -> str:
    share = percent(one.share, 0)
    begun = f"{name} still explains {share} of the whitened residual of {output}, most of it "
    if one.lag < 0:
        return begun + (
            f"{-one.lag:.2g} s before it moved: the response precedes {name} as it is logged. "
            f"So {name} is logged late (free a delay, if none is: nuisance.time_shift, or delays "
            "of the model) or follows the response (feedback); no servo or filter that is missing "
            "does that."
        )
    return begun + f"{one.lag:.2g} s after it moved{f': {remedy.strip()}' if remedy else '.'}"


def across(holes: Sequence[int], size: int) -> np.ndarray:
    """Of (size,) samples those that the filter of `whitening` makes of samples before a hole."""
    after = np.zeros(size, bool)
    for first in holes:
        after[first : first + ORDER] = True
    return after


def explained_by(
    residual: np.ndarray,
    u: np.ndarray,
    dt: float,
    *,
    by_chance: float = 1.0,
    holes: Sequence[int] = (),
) -> Explained | None:
    """What the last samples of an input explain of a residual; None where nothing can be told.

    Both pass the filter that whitens the residual, so that a slow residual does not pass for an
    answer to a slow input.

    Args:
        residual: (N,), NaN where nothing is measured.
        u: the input (N,), any unit.
        dt: [s].
        by_chance: p value above which nothing is told either, in half of the time.
        holes: the samples before which others are missing.
    """
    lags = _lags(dt)
    seen = np.isfinite(residual)
    # A gap would have to be filled, and what fills it looks like a response.
    if not seen.all() or residual.size < _FEWEST * (lags + ORDER):
        return None
    # Of a simulation that has left the record squares would overflow; a share knows no size.
    residual = residual / max(float(np.max(np.abs(residual))), 1e-300)
    e, drive = residual - residual.mean(), u - u.mean()
    if not (np.std(e) > 0 and np.std(drive) > 0):
        return None
    # The filter of the residual is put on the input as well: prewhitening leaves the response
    # between the two as it was, and makes the F test's independent errors true.
    h = whitening(e, holes)
    e, drive = (np.convolve(v, h)[: v.size] for v in (e, drive))
    # Row k is the input k samples before; the first samples have no past.
    first = max(lags, ORDER)
    whole = ~across(holes, e.size)[first:]
    X = np.stack([drive[first - k : drive.size - k] for k in range(lags)])[:, whole]
    y = e[first:][whole]
    y = y - y.mean()
    X -= X.mean(axis=1, keepdims=True)
    # An input held for several samples has rows that are the same: only their rank counts.
    # Of the rows' products, which halves the time of all: a share is told to six digits then.
    products, along = X @ X.T, X @ y
    squares, V = np.linalg.eigh(products)
    kept = squares > 1e-12 * squares[-1]
    followed = (V.T[kept] @ along) / np.sqrt(squares[kept])
    rank, n = int(kept.sum()), y.size
    share = float(np.sum(followed**2) / np.sum(y**2))
    freedom = n - rank - 1
    F = (share / rank) / max((1.0 - share) / freedom, 1e-300)
    # The upper tail itself, not one less the lower: beyond 1e-16 that difference is zero.
    p_value = float(scipy.special.fdtrc(rank, freedom, F))
    if p_value > by_chance:
        return None
    # Less what as many numbers explain of noise.
    share = max(0.0, 1.0 - (1.0 - share) * (n - 1) / freedom)
    # By each lag alone, since the coefficients of a regression on neighbouring lags swing against
    # one another where the input moves slowly.
    correlation = np.abs(along) / np.maximum(np.sqrt(np.diagonal(products)), 1e-300)
    lead = _lead(e, drive, lags)
    lag = float(np.argmax(correlation)) if lead is None else -lead
    return Explained(share, p_value, lag * dt)


def _lead(e: np.ndarray, drive: np.ndarray, lags: int) -> int | None:
    """By how many samples a residual goes with what an input does later; None where it does not."""
    # Nothing that a machine does comes before its input: then clocks differ or the input follows.
    c = _answer(e, drive, lags)
    early = lags - int(np.argmax(c[:lags]))
    enough = max(_EARLIER * float(c[lags:].max()), _BY_CHANCE_AT_MOST / np.sqrt(e.size))
    return early if c[lags - early] > enough else None


def _answer(e: np.ndarray, drive: np.ndarray, lags: int) -> np.ndarray:
    """Size (2 lags + 1,) of the correlation of e with a drive that many samples before, from -lags
    to lags, both through the filter that whitens the drive."""
    # Else what an input does later is foretold by what it has done, and every answer seems to begin
    # before it.
    h = whitening(drive)
    y, x = (np.convolve(v, h)[: v.size][2 * ORDER :] for v in (e, drive))
    return np.abs(cross_correlation(x, y, lags))


def _lags(dt: float) -> int:
    return max(2, min(_MOST_LAGS, round(_SECONDS / dt)))


def whitening(e: np.ndarray, holes: Sequence[int] = ()) -> np.ndarray:
    """The filter (ORDER + 1,) of an autoregression, by Yule and Walker.

    Args:
        e: the signal (N,), of mean zero.
        holes: the samples before which others are missing.
    """
    # With zeros between no sample is compared with one beyond a hole.
    e = np.insert(e, np.repeat(np.asarray(holes, int), ORDER), 0.0)
    c = np.array([float(e[: e.size - k] @ e[k:]) for k in range(ORDER + 1)]) / e.size
    # A little white noise, so that a residual without any has a filter too.
    c[0] *= 1.0 + 1e-9
    return np.concatenate([[1.0], -scipy.linalg.solve_toeplitz(c[:-1], c[1:])])
