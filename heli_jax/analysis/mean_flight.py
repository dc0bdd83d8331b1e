"""The steady flight that is nearest to a record."""

from collections.abc import Mapping

import numpy as np

from heli_jax.analysis.trim import HOVER, Condition

_SLOW = 0.5
"""m/s: a record of less mean speed is of hover"""


def mean_condition(outputs: Mapping[str, np.ndarray], dt: float) -> Condition:
    """The mean motion of a record; hover where it is slow or nothing tells.

    Args:
        outputs: as measured (N,), by name, SI; NaN where missing.
        dt: sample time [s].
    """
    dx, dy, dz = (_mean_rate(outputs, axis, dt) for axis in "xyz")
    psi = mean_heading(outputs)
    # From the axes of the ground to those of the heading, which a trim speaks of.
    forward, lateral = dx * np.cos(psi) + dy * np.sin(psi), dy * np.cos(psi) - dx * np.sin(psi)
    # Records of hover drift: their trim would be called one of forward flight.
    forward, lateral, up = (float(v) if abs(v) >= _SLOW else 0.0 for v in (forward, lateral, dz))
    return Condition(forward, lateral, up, psi) if forward or lateral or up else HOVER


def mean_heading(outputs: Mapping[str, np.ndarray]) -> float:
    """The mean of psi [rad]; 0 where it was not measured.

    Args:
        outputs: as measured (N,), by name, SI; NaN where missing.
    """
    psi = outputs.get("yaw")
    # A circular mean: headings on either side of south are near one another, and far in numbers.
    return 0.0 if psi is None else float(np.angle(np.nanmean(np.exp(1j * psi))))


def _mean_rate(outputs: Mapping[str, np.ndarray], axis: str, dt: float) -> float:
    """Mean velocity along an axis [m/s], from what was measured of it."""
    # A measured velocity tells more than two noisy positions at the ends of the record.
    if f"d{axis}" in outputs:
        return float(np.nanmean(outputs[f"d{axis}"]))
    if axis in outputs:
        seen = np.flatnonzero(np.isfinite(outputs[axis]))
        if seen.size > 1:
            first, last = seen[0], seen[-1]
            return float((outputs[axis][last] - outputs[axis][first]) / ((last - first) * dt))
    return 0.0


def flown(condition: Condition) -> str:
    """A condition in words: `in hover`, `at 12 m/s ahead`."""
    named = (
        ("ahead", condition.forward_speed),
        ("to the right", condition.lateral_speed),
        ("up", condition.climb),
    )
    parts = [f"{v:.2g} m/s {n}" for n, v in named if v]
    return f"at {', '.join(parts)}" if parts else "in hover"
