"""Whether gyro and attitude are turned against one another about the vertical axis.

A gyro that is mounted askew shows some of the roll rate as pitch rate, and a fit takes that for
coupling. Roll and pitch angle tell: each is the integral of a part of the other's rate then, the
one with the sign opposite to the other's, as nothing but a turn makes it.
"""

import numpy as np

from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation.signal_signs import (
    PARTS,
    WITHIN,
    changes_within,
    filled,
    integral,
    jackknife_sd,
)

_TURNED = np.sin(np.radians(3.0))
"""below which a mounting is as good as straight"""
_SURE = 4.0
"""standard deviations of a part, over parts of the record"""
_ALIKE = 2.0
"""factor by which the two parts may differ"""


def turned_sensors(problem: Problem) -> list[Finding]:
    """A doubt for each flight whose rates are about other axes than its angles.

    Args:
        problem: the flights that are fitted.
    """
    flights = problem.training
    findings = []
    for label, flight in zip(labels(flights), flights, strict=True):
        angle = _turn(flight)
        if angle is not None:
            size = np.degrees(angle)
            words = (
                f"{label}: phi and theta are the integrals of p and q turned by {size:.2g} deg "
                "about the vertical axis: gyro and attitude are of sensors that are mounted askew, "
                "and a fit takes that for coupling of roll and pitch. Turn the columns of one."
            )
            criterion = f"{np.degrees(_TURNED):.2g} deg"
            findings.append(Finding("signs.sensors-askew", "doubt", words, float(size), criterion))
    return findings


def _turn(flight: Flight) -> float | None:
    """By how much p and q are turned against phi and theta [rad], where that is sure."""
    if not {"p", "q", "phi", "theta"} <= set(flight.outputs):
        return None
    dt, steps = flight.dt, max(1, round(WITHIN / flight.dt))
    signals = [filled(flight.outputs[n], dt) for n in ("p", "q", "phi", "theta")]
    r = filled(flight.outputs["r"], dt) if "r" in flight.outputs else np.zeros(flight.n_samples)
    if any(s is None for s in (*signals, r)) or flight.n_samples < (PARTS + 1) * steps:
        return None
    p, q, phi, theta = (np.asarray(s) for s in signals)
    phi, r = np.unwrap(phi), np.asarray(r)
    if np.max(np.abs(theta)) > 1.2:
        return None
    # What the angles' rates are of p and q by kinematics, in which the turn is a small correction.
    of_roll = np.tan(theta) * (q * np.sin(phi) + r * np.cos(phi))
    of_pitch = q * (np.cos(phi) - 1.0) - r * np.sin(phi)
    X = np.stack([changes_within(integral(v, dt), dt) for v in (p, q)], axis=1)
    parts = []
    for angle, rest, other in ((phi, of_roll, 1), (theta, of_pitch, 0)):
        parts.append(_part(X, changes_within(angle - integral(rest, dt), dt), other))
    (a, sd_a), (b, sd_b) = parts
    alike = a * b < 0 and 1.0 / _ALIKE < abs(a / b) < _ALIKE
    if not (alike and abs(a) > _SURE * sd_a and abs(b) > _SURE * sd_b):
        return None
    size = 0.5 * (b - a)
    return float(np.arcsin(np.clip(size, -1.0, 1.0))) if abs(size) > _TURNED else None


def _part(X: np.ndarray, y: np.ndarray, k: int) -> tuple[float, float]:
    """A regression's coefficient k, and its standard deviation by leaving out one part of the
    record after the other (the jackknife)."""
    if np.linalg.cond(X) > 1e3:
        return 0.0, np.inf
    rows = np.array_split(np.arange(y.size), PARTS)
    products = [X[i].T @ X[i] for i in rows]
    along = [X[i].T @ y[i] for i in rows]
    whole, both = sum(products), sum(along)
    each = [np.linalg.solve(whole - P, both - v)[k] for P, v in zip(products, along, strict=True)]
    return float(np.linalg.solve(whole, both)[k]), jackknife_sd(each)
