"""Uniform grid of a log's time stamps, if they form one."""

import math
from dataclasses import dataclass

import numpy as np

from heli_jax.finding import Finding

JITTER_ALLOWED = 0.1  # largest error of a step, in steps, unless rounding explains more
LATEST = 1e12  # s, beyond any calendar; keeps sums and differences of stamps finite
SHORTEST_STEP = 1e-9  # s
_JITTER_NOTED = 0.01
_DRIFT_ALLOWED = 0.5  # in steps
_FEWEST_DIGITS = 5  # nobody logs fewer significant digits
_FEWEST_STAMPS = 8  # fewer may be round numbers by accident
_COARSEST = 0.9  # in steps; coarser stamps, rounded to a whole step, cannot show a lost sample
_ON = 100.0  # in usual steps; largest step across the overflow of a counter


@dataclass(frozen=True)
class Grid:
    """A uniform grid: the time between samples [s] and the largest error of a step, in steps."""

    dt: float
    jitter: float

    @property
    def notes(self) -> tuple[Finding, ...]:
        """Notes for readers of the results."""
        if self.jitter <= _JITTER_NOTED:
            return ()
        words = (
            f"the time stamps jitter by up to {100 * self.jitter:.2g} % of a step; the samples are"
            f" taken as uniform, {self.dt:.6g} s apart"
        )
        return (Finding("clock.jitter", "note", words, self.jitter, "steps"),)


@dataclass(frozen=True)
class Uneven:
    """Reason why stamps are no uniform grid: the sample after the worst step, and its sizes [s].

    `drift` is the largest distance of the stamps from a straight line, in steps, if that is the
    reason.
    """

    row: int
    step: float
    usual: float
    drift: float | None = None


def not_increasing(stamps: np.ndarray) -> tuple[int, str] | None:
    """Return row and fault of the first of the stamps (N,) not later than the previous one."""
    steps = np.diff(stamps)
    back = np.flatnonzero(steps <= 0)
    if not back.size:
        return None
    row = int(back[0])
    return row + 1, "stands still" if steps[row] == 0 else "runs backwards"


def clock_fault(times: np.ndarray) -> tuple[int, str] | None:
    """Return the row and the fault of the first of the times (N,) [s] that is none of a clock."""
    bad = np.flatnonzero(~(np.abs(times) <= LATEST))  # NaN is bad too
    if bad.size:
        return int(bad[0]), "is no time"
    if (back := not_increasing(times)) is not None:
        return back
    # The median, because one long gap would raise the mean above any limit.
    if times.size > 1 and np.median(np.diff(times)) < SHORTEST_STEP:
        return 0, "has a usual step below 1 ns (look at its unit)"
    return None


_COUNTER = 2.0**32
"""Ticks after which a 32-bit counter overflows: 71.6 minutes of microseconds."""


def without_overflow(stamps: np.ndarray) -> np.ndarray:
    """Return the stamps (N,) of a 32-bit counter, unwrapped."""
    steps = np.diff(stamps)
    back = np.flatnonzero(steps < 0)
    # An overflow falls by nearly the whole range of the counter and then continues as before.
    if not back.size or not (stamps.min() >= 0 and stamps.max() < _COUNTER):
        return stamps
    on = steps[back] + _COUNTER
    usual = float(np.median(steps))
    if not np.all((on > 0) & (on <= _ON * usual)) or np.any(stamps != np.rint(stamps)):
        return stamps
    turns = np.cumsum(np.r_[0, steps < 0])
    return stamps + _COUNTER * turns


def uniform_grid(elapsed: np.ndarray, rounding: float) -> Grid | Uneven:
    """Return the uniform grid of stamps (N,) [s], N >= 2 and strictly increasing.

    There is one in two cases. Either no step errs by more than a tenth and no stamp leaves a
    straight line by half a step. Or all stamps are as near to a line as `rounding` [s] allows.
    """
    steps = np.diff(elapsed)
    # Neither the first step nor the median: stamps in milliseconds at 300 Hz are 3 or 4 ms apart.
    i = np.arange(elapsed.size) - 0.5 * (elapsed.size - 1)
    slope = float(i @ (elapsed - elapsed.mean()) / (i @ i))  # of the least-squares line
    dt = _plain(slope, 2 * rounding / float(elapsed[-1] - elapsed[0]))
    jitter = float(np.abs(steps - dt).max() / dt)
    # Half the band's width is the distance from the line in its middle.
    drift = _spread(elapsed, dt) / dt / 2
    if jitter <= JITTER_ALLOWED and drift < _DRIFT_ALLOWED:
        return Grid(dt, jitter)
    # Coarse stamps jitter by up to their rounding and may still be exact. Rounded stamps are in a
    # band no wider than the rounding around some line, but not the least-squares line.
    if rounding <= _COARSEST * dt:
        nearest = _step_of_least_spread(elapsed, slope)
        if _spread(elapsed, nearest) <= rounding * (1 + 1e-6):
            return Grid(dt, jitter)
    usual = float(np.median(steps))
    error = np.abs(steps - usual)
    row = int(np.argmax(error >= error.max() * (1 - 1e-6)))  # the first of equals
    only_drift = jitter <= JITTER_ALLOWED
    return Uneven(row + 1, float(steps[row]), usual, drift if only_drift else None)


def _spread(elapsed: np.ndarray, dt: float) -> float:
    """Return the width [s] of the band of slope `dt` that contains all stamps (N,)."""
    return float(np.ptp(elapsed - dt * np.arange(elapsed.size)))


def _step_of_least_spread(elapsed: np.ndarray, dt: float) -> float:
    """Return the slope of the narrowest band, by ternary search, because the width is convex."""
    reach = 2 * _spread(elapsed, dt) / elapsed.size
    low, high = dt - reach, dt + reach
    for _ in range(60):  # (2/3)^60 of the range: below the resolution of float64
        third = (high - low) / 3
        if _spread(elapsed, low + third) < _spread(elapsed, high - third):
            high -= third
        else:
            low += third
    return 0.5 * (low + high)


def _plain(dt: float, tolerance: float) -> float:
    """Return a whole rate or few digits that agree with `dt`: 0.01, not 0.0099999.

    `tolerance` is relative.
    """
    # A long log of coarse stamps fixes its step far better than 0.1 %; a short one must not turn
    # 49.6 Hz into 50.
    tolerance = min(max(tolerance, 1e-10), 1e-3)
    candidates = [float(f"{dt:.9g}")]
    if dt < 1:  # a whole number of Hz, such as 1/300 s, may need many digits of dt
        candidates.insert(0, 1 / round(1 / dt))
    return next((c for c in candidates if abs(c / dt - 1) <= tolerance), dt)


def rounding_of(stamps: np.ndarray) -> float:
    """Return the rounding of stamps (N,), N >= 2 and strictly increasing, in their unit.

    It is the largest power of ten, up to a step, of which all stamps are multiples. Otherwise it is
    the resolution of float32 if that fits, else of float64. With a fixed number of significant
    digits, later stamps are rounded more coarsely. Stamps with the most digits before the point
    therefore decide.
    """
    size = np.abs(stamps)
    largest = float(size.max())
    top = math.floor(math.log10(largest))
    late = size[size >= 10.0**top]
    resolved = float(np.spacing(largest))
    # 1e-9: the logarithm of 0.01 is -2 only up to rounding.
    coarse = math.floor(math.log10(float(np.median(np.diff(stamps)))) + 1e-9)
    for exponent in range(coarse, coarse - 6, -1):
        unit = 10.0**exponent
        by_digits = top - exponent + 1 >= _FEWEST_DIGITS and late.size >= _FEWEST_STAMPS
        multiples = (late if by_digits else size) / unit
        error = np.abs(multiples - np.rint(multiples)).max()
        # Near the resolution of float64 every number is a multiple of anything.
        if unit > 100 * resolved and error <= max(1e-9, 4 * resolved / unit):
            return unit
    # A logger that counts seconds in float32 since boot steps by 1 ms after some hours.
    with np.errstate(over="ignore", under="ignore"):
        single = size.astype(np.float32)
    return max(resolved, float(np.spacing(single.max())) if np.all(single == size) else 0.0)
