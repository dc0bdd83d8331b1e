"""Inputs that are logged later than the machine answered them.

No machine answers before its input. Where the past of an output and of all inputs leaves something
of the output unexplained that an input's future explains, that input is logged late, or it follows
the output (C. A. Sims, Money, income, and causality, Am. Econ. Rev. 62, 1972).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float

from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.numbers import percent

LATE = "timing.late-input"
"""the topic of such a finding"""
_RATE = 50.0
"""[Hz] to which logs are averaged, so that the verdict is the same at any rate of the log: samples
that come faster each tell less"""
_SECONDS = 0.4
"""past and future of an input that are looked at"""
_OWN = 6
"""past samples of the output that foretell it"""
_FEWEST = 10
"""samples for each regressor"""
_CLEAR = 0.1
"""part of what the past does not foretell of an output that an input's future explains, from which
on it is spoken of"""
_BY_CHANCE = 1e-6
"""probability of as much by chance, at most"""


def late_inputs(
    flights: Sequence[tuple[str, Flight]], feedback: Sequence[Feedback]
) -> list[Finding]:
    """A doubt for each input that an output precedes; by flight the surest output alone.

    Args:
        flights: by what each is called.
        feedback: inputs that follow the response, of which it is said that they may be late.
    """
    said = {(one.flight, one.input) for one in feedback if one.present}
    findings = []
    for label, flight in flights:
        surest: dict[str, tuple[float, float, str]] = {}
        for output, y in flight.outputs.items():
            led = led_by(y, flight.inputs, flight.dt)
            if led is not None and (label, led[2]) not in said:
                share, lead, name = led
                surest[name] = max(surest.get(name, (0.0, 0.0, "")), (share, lead, output))
        findings += [_finding(label, name, *one) for name, one in surest.items()]
    return findings


def led_by(
    y: Float[np.ndarray, " N"], inputs: Mapping[str, Float[np.ndarray, " N"]], dt: float
) -> tuple[float, float, str] | None:
    """Of the input whose future explains most of an output what it explains of what the past leaves
    (0 to 1), by how much the output precedes it [s], and its name; None where none is.

    Args:
        y: the output, NaN where nothing is measured.
        inputs: by name, any unit.
        dt: [s].
    """
    moving = {n: u for n, u in inputs.items() if np.isfinite(u).all() and np.ptp(u) > 0}
    if not moving or not np.isfinite(y).all() or not np.ptp(y) > 0:
        return None
    count = max(1, round(1.0 / (_RATE * dt)))
    step = count * dt
    slow, drives = _averaged(y, count), {n: _averaged(u, count) for n, u in moving.items()}
    shares = {n: _of_future(slow, drives, n, step) for n in drives}
    name, share = max(shares.items(), key=lambda item: item[1])
    if share < _CLEAR:
        return None
    # By as much as that input has to be moved ahead until its future tells no more.
    most = max(1, round(_SECONDS / step))
    for k in range(1, most + 1):
        ahead = {n: u[k:] if n == name else u[: u.size - k] for n, u in drives.items()}
        if _of_future(slow[: slow.size - k], ahead, name, step) < _CLEAR:
            return share, k * step, name
    return share, most * step, name


def _averaged(x: np.ndarray, count: int) -> np.ndarray:
    """Means (N // count,) of so many samples."""
    size = x.size // count
    return x[: size * count].reshape(size, count).mean(axis=1)


def _of_future(y: np.ndarray, drives: Mapping[str, np.ndarray], name: str, step: float) -> float:
    """Part of what the past of all leaves of an output that an input's future explains, less what
    as many numbers explain of noise; 0 where chance makes as much."""
    lags = max(2, round(_SECONDS / step))
    first, last = max(lags, _OWN), y.size - lags
    regressors = _OWN + len(drives) * (lags + 1) + lags
    if last - first < _FEWEST * regressors:
        return 0.0

    def column(x: np.ndarray, k: int) -> np.ndarray:
        return x[first - k : last - k]

    past = [column(y, k) for k in range(1, _OWN + 1)] + [np.ones(last - first)]
    past += [column(u, k) for u in drives.values() for k in range(lags + 1)]
    # A step within a mean is told in full by the next one: that is no lead yet.
    past += [column(u, -1) for u in drives.values()]
    known = _basis(np.stack(past, axis=1))
    future = np.stack([column(drives[name], -k) for k in range(2, lags + 1)], axis=1)
    size = float(np.linalg.norm(future - future.mean(axis=0), axis=0).max())
    new = _basis(future - known @ (known.T @ future), size)
    rest = column(y, 0) - known @ (known.T @ column(y, 0))
    freedom = rest.size - known.shape[1] - new.shape[1]
    power = float(rest @ rest)
    if not (new.shape[1] and power > 0):
        return 0.0
    share = min(float(np.sum((new.T @ rest) ** 2)) / power, 1.0)
    F = share / new.shape[1] / max((1.0 - share) / freedom, 1e-300)
    if scipy.special.fdtrc(new.shape[1], freedom, F) > _BY_CHANCE:
        return 0.0
    return max(0.0, 1.0 - (1.0 - share) * (freedom + new.shape[1]) / freedom)


def _basis(X: np.ndarray, size: float | None = None) -> np.ndarray:
    """Orthonormal columns (N, rank) that span those of X (N, m); of the columns' own size, or of
    `size`, what is rounding is left out."""
    norms = np.linalg.norm(X, axis=0) if size is None else np.full(X.shape[1], size)
    scaled = X / np.maximum(norms, 1e-300)
    parts: Any = scipy.linalg.qr(scaled, mode="economic", pivoting=True)
    Q, R = parts[:2]
    values = np.abs(np.diag(R))
    return Q[:, values > (1e-8 * values[0] if size is None else 1e-6)]


def _finding(label: str, name: str, share: float, lead: float, output: str) -> Finding:
    words = (
        f"{label}: {output} moves {lead:.2g} s or more before {name} does (what {name} does later "
        f"explains {percent(share, 0)} of what the past leaves of {output}): {name} is logged late "
        "(free a delay: fit.nuisance.time_shift, or delays of the model) or follows the response "
        "(feedback)."
    )
    criterion = f"part of what the past leaves that the later input explains, {_CLEAR:g}"
    return Finding(LATE, "doubt", words, share, criterion)
