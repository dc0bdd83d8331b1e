"""Whether a log's time stamps are a uniform grid, and which one."""

from dataclasses import dataclass

import numpy as np

JITTER_ALLOWED = 0.1  # of a step, where rounding does not explain more
_JITTER_NOTED = 0.01
_FEW = 5  # so few steps of double length are lost samples, not rounding


@dataclass(frozen=True)
class Grid:
    """A uniform grid: the time between samples [s] and the largest error of a step, in steps."""

    dt: float
    jitter: float

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the results should know of it."""
        if self.jitter <= _JITTER_NOTED:
            return ()
        return (
            f"the time stamps jitter by up to {100 * self.jitter:.2g} % of a step; the samples are"
            f" taken as uniform, {self.dt:.6g} s apart",
        )


@dataclass(frozen=True)
class Uneven:
    """Why stamps are no uniform grid: the sample after the worst step, and the sizes [s].

    `drift` is how far the stamps leave a straight line, in steps, where that is the reason.
    """

    row: int
    step: float
    usual: float
    drift: float | None = None


def uniform_grid(seconds: np.ndarray, rounding: np.ndarray) -> Grid | Uneven:
    """The uniform grid that stamps (N,) [s] stand for, N >= 2 and strictly increasing.

    Every step may err by a tenth of the mean step, or by the rounding (N,) [s] of its stamps,
    and no stamp may leave a straight line by half a step.
    """
    with np.errstate(all="ignore"):
        steps = np.diff(seconds)
        usual = float(np.median(steps))
        dt = float((seconds[-1] - seconds[0]) / steps.size)
        error = np.abs(steps - dt)
        allowed = np.maximum(JITTER_ALLOWED * dt, np.maximum(rounding[1:], rounding[:-1]))
        far = np.count_nonzero(error > 0.5 * dt)
        if not np.all(error <= allowed * (1 + 1e-6)) or 0 < far < _FEW:
            row = int(np.argmax(np.abs(steps - usual)))
            return Uneven(row + 1, float(steps[row]), usual)
        drift = np.abs(_leave_line(seconds)) / dt
        row = int(np.argmax(drift))
        if not drift[row] < 0.5:
            return Uneven(row, float(steps[max(row - 1, 0)]), usual, float(drift[row]))
        return Grid(_plain(dt, seconds), float(error.max() / dt))


def _leave_line(seconds: np.ndarray) -> np.ndarray:
    """Distance [s] of each stamp (N,) from the straight line of least squares."""
    i = np.arange(seconds.size) - 0.5 * (seconds.size - 1)
    t = seconds - seconds[0]
    t = t - t.mean()
    return t - i * (i @ t) / (i @ i)


def _plain(dt: float, seconds: np.ndarray) -> float:
    """`dt` without the digits that are errors of floating point: 0.01, not 0.0100000000000003."""
    plain = float(f"{dt:.10g}")
    error = 4 * float(np.spacing(np.abs(seconds).max()))
    return plain if plain > 0 and abs(plain - dt) * seconds.size <= error else dt


def rounding_of(stamps: np.ndarray) -> np.ndarray:
    """How coarsely each stamp (N,) is rounded, in the stamps' unit.

    Read from the stamps themselves: their decimals, or their significant digits (then the later
    stamps are the coarser), or a float32 column. Where nothing is evident it is what float64
    resolves.
    """
    size = np.abs(stamps)
    with np.errstate(all="ignore"):
        single = size.astype(np.float32)
        binary = np.spacing(single if np.all(single == size) else size).astype(np.float64)
    return np.maximum(_decimal_rounding(size), binary)


def _decimal_rounding(size: np.ndarray) -> np.ndarray:
    unit = np.zeros(size.size)
    left = np.arange(size.size)
    for decimals in range(-3, 10):
        scaled = size[left] * 10.0**decimals
        tolerance = 4 * np.finfo(float).eps * np.maximum(scaled, 1.0)
        whole = np.abs(scaled - np.rint(scaled)) <= tolerance
        unit[left[whole]] = 10.0**-decimals
        left = left[~whole]
    with np.errstate(divide="ignore"):
        decade = np.where(size > 0, np.floor(np.log10(size)), -400)
    # A stamp such as 0.5 among thousandths only looks coarse: the finest of its decade counts,
    # and no decade is finer than one above it.
    finest = np.inf
    for d in np.unique(decade)[::-1]:
        members = decade == d
        finest = min(finest, unit[members].min())
        unit[members] = finest
    return unit
