"""What is kept of each run of a sweep: numbers that are gathered while the run goes on.

A reducer starts with some running values, updates them at every sample, and turns them into its
result at the end, so that nothing of the run is stored. A function of a whole run may take its
place; the runs of one block are then held while it works.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from heli_jax.errors import nearest


class Measured(NamedTuple):
    """A measured signal, with zeros where nothing was measured, and its moments."""

    values: Any
    """(N,), or the value at one sample"""
    seen: Any
    """(N,), 1 where something was measured, else 0; or that at one sample; None: everywhere"""
    count: Any
    spread: Any
    """sum of squares about the mean"""
    power: Any
    """sum of squares"""


class Streaming(NamedTuple):
    """A reducer that goes along with a run.

    `start` is a pytree of numbers; value = update(value, y, measured) at each sample, with the
    signal's value there and, where the flight has it, a Measured of it (else None);
    finish(value, n, measured) is the result after n samples. A Streaming of one's own without a
    signal gets the whole Outputs for y, and no measured signal.
    """

    start: Any
    update: Callable[[Any, Any, Any], Any]
    finish: Callable[[Any, Any, Any], Any]
    against_flight: bool = False
    """whether it compares with what the flight measured"""
    unit: str | None = None
    """of the result; None: that of the signal"""


class Reduce(NamedTuple):
    """A named result of a sweep: `how`, of which signal."""

    how: str | Callable[[Any], Any] | Streaming
    """a name of `REDUCERS` or of `LINEAR`, a function of a Trajectory, or a Streaming"""
    signal: str | None = None
    """an output of the model"""
    input: str | None = None
    """the input at which margins break the loop"""
    gain: float = 1.0
    """of the loop that the margins are of: the input is -gain times the signal"""


def measured(values: np.ndarray, dtype: Any) -> Measured:
    """A measured signal (N,), NaN where one is missing, for the reducers."""
    seen = np.isfinite(values)
    known = values[seen]
    spread = float(np.sum((known - known.mean()) ** 2)) if known.size else 0.0
    return Measured(
        np.where(seen, values, 0.0).astype(dtype),
        None if seen.all() else seen.astype(dtype),
        np.asarray(known.size, dtype),
        np.asarray(spread, dtype),
        np.asarray(np.sum(known**2), dtype),
    )


def _summed(value: Any, y: Any, _: Any) -> Any:
    return value + y


def _squared(value: Any, y: Any, _: Any) -> Any:
    return value + y * y


def _mean(value: Any, n: Any, _: Any) -> Any:
    return value / n


def _root_mean(value: Any, n: Any, _: Any) -> Any:
    return jnp.sqrt(value / n)


def _same(value: Any, n: Any, _: Any) -> Any:
    return value


def _where(v: Any, m: Measured) -> Any:
    return v if m.seen is None else v * m.seen


def _misfit(value: Any, y: Any, m: Measured) -> Any:
    e = _where(m.values - y, m)
    return value + e * e


def _rmse(value: Any, n: Any, m: Measured) -> Any:
    return jnp.sqrt(value / m.count)


def _nrmse(value: Any, n: Any, m: Measured) -> Any:
    return jnp.sqrt(value / m.spread)


def _fit_percent(value: Any, n: Any, m: Measured) -> Any:
    return 100.0 * (1.0 - jnp.sqrt(value / m.spread))


def _misfit_and_sum(value: Any, y: Any, m: Measured) -> Any:
    e = _where(m.values - y, m)
    return (value[0] + e * e, value[1] + e)


def _vaf(value: Any, n: Any, m: Measured) -> Any:
    squares, total = value
    return 1.0 - (squares - total * total / m.count) / m.spread


def _misfit_and_power(value: Any, y: Any, m: Measured) -> Any:
    e, seen = _where(m.values - y, m), _where(y, m)
    return (value[0] + e * e, value[1] + seen * seen)


def _theil(value: Any, n: Any, m: Measured) -> Any:
    return jnp.sqrt(value[0]) / (jnp.sqrt(value[1]) + jnp.sqrt(m.power))


REDUCERS: dict[str, Streaming] = {
    "rms": Streaming(0.0, _squared, _root_mean),
    "mean": Streaming(0.0, _summed, _mean),
    "peak": Streaming(0.0, lambda v, y, _: jnp.maximum(v, jnp.abs(y)), _same),
    "max": Streaming(-np.inf, lambda v, y, _: jnp.maximum(v, y), _same),
    "min": Streaming(np.inf, lambda v, y, _: jnp.minimum(v, y), _same),
    "final": Streaming(0.0, lambda v, y, _: y, _same),
    "rmse": Streaming(0.0, _misfit, _rmse, True),
    "nrmse": Streaming(0.0, _misfit, _nrmse, True, "1"),
    "fit": Streaming(0.0, _misfit, _fit_percent, True, "%"),
    "vaf": Streaming((0.0, 0.0), _misfit_and_sum, _vaf, True, "1"),
    "tic": Streaming((0.0, 0.0), _misfit_and_power, _theil, True, "1"),
}
"""Of one signal: root mean square, mean, largest magnitude, largest, smallest and last value; and
against the flight: root mean square error, that over the measured signal's spread (nrmse, 0 is
perfect), 100 (1 - nrmse) (fit), variance accounted for, Theil inequality coefficient."""

LINEAR = ("modes", "margins")
"""Of the model linearised where the run begins: eigenvalues; gain and phase margin of a loop."""


def check(name: str, one: Reduce, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    """Refuse a reducer that the model cannot have.

    Raises:
        ValueError: an unknown `how`, an output or input that the model lacks, or none where one is
            needed.
    """
    where = f"reduce.{name}"
    if isinstance(one.how, str) and one.how not in (*REDUCERS, *LINEAR):
        known = [*REDUCERS, *LINEAR]
        raise ValueError(f"{where}.how: unknown reducer {one.how!r}{nearest(one.how, known)}")
    needs_signal = one.how == "margins" or one.how in REDUCERS
    if needs_signal and one.signal is None:
        raise ValueError(f"{where}.signal: missing, expected one of {', '.join(outputs)}")
    if one.signal is not None and one.signal not in outputs:
        raise ValueError(
            f"{where}.signal: the model has no output {one.signal!r}{nearest(one.signal, outputs)}"
        )
    if one.how == "margins" and one.input is None:
        raise ValueError(f"{where}.input: missing, expected one of {', '.join(inputs)}")
    if one.input is not None and one.input not in inputs:
        raise ValueError(
            f"{where}.input: the model has no input {one.input!r}{nearest(one.input, inputs)}"
        )
    if one.input is not None and one.how != "margins":
        raise ValueError(f"{where}.input: only margins take one")
    if one.how != "margins" and one.gain != 1.0:
        raise ValueError(f"{where}.gain: only margins take one")
    whole = callable(one.how) and not isinstance(one.how, Streaming)
    if one.signal is not None and (whole or one.how == "modes"):
        what = "modes are" if one.how == "modes" else "a function of a Trajectory is"
        raise ValueError(f"{where}.signal: {what} of no one signal, expected none")
    if one.how == "margins" and not (np.isfinite(one.gain) and one.gain != 0):
        raise ValueError(f"{where}.gain: expected a number that is not zero, got {one.gain}")


def streaming(one: Reduce) -> Streaming | None:
    """The reducer itself, or None where it is none that goes along with a run."""
    if isinstance(one.how, Streaming):
        return one.how
    return REDUCERS.get(one.how) if isinstance(one.how, str) else None
