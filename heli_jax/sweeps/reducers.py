"""Reducers: numbers computed from each run of a sweep during the simulation.

A reducer starts with running values, updates them at every sample, and computes its result at the
end. The run itself is not stored. A function of a whole run may replace it; the runs of one block
are then stored for it.
"""

# `Any` below: the running values of a user's Streaming are any pytree, and without a signal it gets
# the model's Outputs. The reducers here have scalars, ().

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from heli_jax.errors import nearest


class Measured(NamedTuple):
    """A measured signal, with zeros where it is missing, and its moments."""

    values: Any
    """Values (N,), or the value at one sample."""
    seen: Any
    """Mask (N,), 1 where measured, else 0, or its value at one sample; None if all are measured."""
    count: Any
    total_squares: Any
    """Sum of squares about the mean, as in R^2."""
    power: Any
    """Sum of squares."""


class Streaming(NamedTuple):
    """A reducer that is updated during a run.

    `start` is a pytree of numbers. value = update(value, y, measured) is called at each sample,
    with the signal's value and its Measured, or None if the flight lacks it. finish(value, n,
    measured) returns the result after n samples. A user's Streaming without a signal gets the whole
    Outputs for y, and no measured signal.
    """

    start: Any
    update: Callable[[Any, Any, Any], Any]
    finish: Callable[[Any, Any, Any], Any]
    against_flight: bool = False
    """True if it compares with the flight's measurement."""
    unit: str | None = None
    """Unit of the result; None for that of the signal."""


class Reduce(NamedTuple):
    """A named result of a sweep: a reducer and its signal."""

    how: str | Callable[[Any], Any] | Streaming
    """A name in `REDUCERS` or `LINEAR`, a function of a Trajectory, or a Streaming."""
    signal: str | None = None
    """An output of the model."""
    input: str | None = None
    """Input at which margins break the loop."""
    gain: float = 1.0
    """Gain of the loop for margins: the input is -gain times the signal."""


def measured(values: np.ndarray, dtype: np.dtype) -> Measured:
    """Return a measured signal (N,), NaN where one is missing, in the form for reducers."""
    seen = np.isfinite(values)
    known = values[seen]
    # Computed once in float64 and about the mean: sums accumulated along the run would lose digits.
    total_squares = float(np.sum((known - known.mean()) ** 2)) if known.size else 0.0
    return Measured(
        # Zeros and a mask, because 0 times NaN is NaN and would spoil every sum.
        np.where(seen, values, 0.0).astype(dtype),
        # Without missing samples no mask, which saves a product per sample.
        None if seen.all() else seen.astype(dtype),
        np.asarray(known.size, dtype),
        np.asarray(total_squares, dtype),
        np.asarray(np.sum(known**2), dtype),
    )


def _seen(v: Array, m: Measured) -> Array:
    """Return the value, or zero where nothing was measured."""
    return v if m.seen is None else v * m.seen


def _squares(v: Array, y: Array, m: Measured) -> Array:
    e = _seen(m.values - y, m)
    return v + e * e


def _squares_and_sum(v: tuple[Array, Array], y: Array, m: Measured) -> tuple[Array, Array]:
    e = _seen(m.values - y, m)
    return v[0] + e * e, v[1] + e


def _squares_and_power(v: tuple[Array, Array], y: Array, m: Measured) -> tuple[Array, Array]:
    seen = _seen(y, m)
    return _squares(v[0], y, m), v[1] + seen * seen


def _vaf(v: tuple[Array, Array], n: Array, m: Measured) -> Array:
    # 1 - var(e) / var(measured): sum (e - mean e)^2 = sum e^2 - (sum e)^2 / count, in one pass.
    return 1.0 - (v[0] - v[1] * v[1] / m.count) / m.total_squares


def _theil(v: tuple[Array, Array], n: Array, m: Measured) -> Array:
    # Theil's inequality coefficient, 0 to 1: rms(e) / (rms(y) + rms(measured)); the counts cancel.
    return jnp.sqrt(v[0]) / (jnp.sqrt(v[1]) + jnp.sqrt(m.power))


def _nrmse(v: Array, n: Array, m: Measured) -> Array:
    return jnp.sqrt(v / m.total_squares)


def _same(v: Array, n: Array, m: Measured | None) -> Array:
    return v


# Start, update (value, y, measured), finish (value, n, measured), whether it compares with the
# flight, unit of the result.
REDUCERS: dict[str, Streaming] = {
    "rms": Streaming(0.0, lambda v, y, m: v + y * y, lambda v, n, m: jnp.sqrt(v / n)),
    "mean": Streaming(0.0, lambda v, y, m: v + y, lambda v, n, m: v / n),
    # A magnitude is never negative, so zero is a valid start.
    "peak": Streaming(0.0, lambda v, y, m: jnp.maximum(v, jnp.abs(y)), _same),
    # Starts at infinity, so that the first sample always replaces it.
    "max": Streaming(-np.inf, lambda v, y, m: jnp.maximum(v, y), _same),
    "min": Streaming(np.inf, lambda v, y, m: jnp.minimum(v, y), _same),
    "final": Streaming(0.0, lambda v, y, m: y, _same),
    "rmse": Streaming(0.0, _squares, lambda v, n, m: jnp.sqrt(v / m.count), True),
    "nrmse": Streaming(0.0, _squares, _nrmse, True, "1"),
    # As MATLAB's `compare`: 100 is perfect, 0 is no better than the measured mean.
    "fit": Streaming(0.0, _squares, lambda v, n, m: 100.0 * (1.0 - _nrmse(v, n, m)), True, "%"),
    "vaf": Streaming((0.0, 0.0), _squares_and_sum, _vaf, True, "1"),
    "tic": Streaming((0.0, 0.0), _squares_and_power, _theil, True, "1"),
}
"""Reducers of one signal: root mean square, mean, largest magnitude, largest, smallest and last
value. Against the flight: root mean square error; the same over the measured signal's spread
(nrmse, 0 is perfect); 100 (1 - nrmse) (fit); variance accounted for; Theil coefficient."""

LINEAR = ("modes", "margins")
"""Results of the model linearised at the start of the run: eigenvalues; gain and phase margin of a
loop."""


def check(name: str, reduce: Reduce, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    """Refuse a reducer that the model cannot have.

    Args:
        name: name of the result.
        outputs: names of the model's outputs.
        inputs: names of its inputs.

    Raises:
        ValueError: an unknown `how`, an output or input that the model lacks, or none where one is
            required.
    """
    where, reducer = f"reduce.{name}", reduce.how
    # Checked before the first run, so that a misspelt name does not end a sweep of hours.
    if isinstance(reducer, str) and reducer not in (*REDUCERS, *LINEAR):
        known = [*REDUCERS, *LINEAR]
        raise ValueError(f"{where}.how: unknown reducer {reducer!r}{nearest(reducer, known)}")
    _check_signal(where, reduce, outputs)
    _check_loop(where, reduce, inputs)


def _check_signal(where: str, reduce: Reduce, outputs: tuple[str, ...]) -> None:
    """Refuse a signal that is missing, unknown or unused."""
    reducer, signal = reduce.how, reduce.signal
    if (reducer == "margins" or reducer in REDUCERS) and signal is None:
        raise ValueError(f"{where}.signal: missing, expected one of {', '.join(outputs)}")
    if signal is not None and signal not in outputs:
        raise ValueError(
            f"{where}.signal: the model has no output {signal!r}{nearest(signal, outputs)}"
        )
    # An unused signal is refused too, because results of one output and of all look alike in a
    # table.
    whole = callable(reducer) and not isinstance(reducer, Streaming)
    if signal is not None and (whole or reducer == "modes"):
        what = "modes are" if reducer == "modes" else "a function of a Trajectory is"
        raise ValueError(f"{where}.signal: {what} needs no signal, expected none")


def _check_loop(where: str, reduce: Reduce, inputs: tuple[str, ...]) -> None:
    """Refuse margins without a loop, and a loop without margins."""
    margins = reduce.how == "margins"
    if margins and reduce.input is None:
        raise ValueError(f"{where}.input: missing, expected one of {', '.join(inputs)}")
    if reduce.input is not None and reduce.input not in inputs:
        raise ValueError(
            f"{where}.input: the model has no input {reduce.input!r}{nearest(reduce.input, inputs)}"
        )
    if reduce.input is not None and not margins:
        raise ValueError(f"{where}.input: only margins have an input, got {reduce.input!r}")
    # Refused, not ignored: a user expects a stated gain to act.
    if reduce.gain != 1.0 and not margins:
        raise ValueError(f"{where}.gain: only margins have a gain, got {reduce.gain}")
    # A gain of zero is no loop: its margins would be infinite for any vehicle.
    if margins and not (np.isfinite(reduce.gain) and reduce.gain != 0):
        raise ValueError(f"{where}.gain: expected a number that is not zero, got {reduce.gain}")


def streaming(reduce: Reduce) -> Streaming | None:
    """Return the streaming reducer of a result, or None if it has none."""
    if isinstance(reduce.how, Streaming):
        return reduce.how
    return REDUCERS.get(reduce.how) if isinstance(reduce.how, str) else None
