"""The flybar simulated in the rotating frame, as a reference for eq. 12.

A seesaw bar is on a shaft, with one hinge across it. At either end is a paddle between R1 and R2,
with the blade's chord c and slope a. If is the inertia of the whole (thin) bar about the hinge. The
first paddle's azimuth chi = Omega t counts counter-clockwise seen from above, from the nose. beta
is its angle up from the plane across the shaft. The shaft rolls right at p and pitches nose-up at
q.
"""

import numpy as np
from scipy.integrate import solve_ivp

XCELL = {
    "rho": 1.225,
    "a": 6.0,
    "c": 0.0603,
    "R1": 0.231,
    "R2": 0.312,
    "If": 0.0104,
    "Omega": 157.1,
}


def rates(v, t, y, roll, pitch, p, q):
    """Return the derivatives of (beta, dbeta); `roll` and `pitch` are x/L5 [rad], not rotating."""
    beta, dbeta = y
    Om, chi = v["Omega"], v["Omega"] * t
    # 90 degrees of lead: roll right is most pitch at the nose, nose up is most pitch on the right
    theta = roll * np.cos(chi) - pitch * np.sin(chi)
    # shaft rate along the bar and along the hinge, which points 90 degrees ahead of the bar
    along, hinge = p * np.cos(chi) - q * np.sin(chi), -p * np.sin(chi) - q * np.cos(chi)
    dhinge = -Om * along
    # one paddle: 1/2 rho c a int (Om^2 r^2 theta - Om r^2 (dbeta - hinge)) r dr; the other equal
    span = (v["R2"] ** 4 - v["R1"] ** 4) / 4
    moment = v["rho"] * v["a"] * v["c"] * span * (Om**2 * theta - Om * (dbeta - hinge))
    # Lagrange, kinetic energy If/2 ((dbeta - hinge)^2 + (Om cos beta - along sin beta)^2)
    sin, cos = np.sin(beta), np.cos(beta)
    centrifugal = (Om * cos - along * sin) * (Om * sin + along * cos)
    return [dbeta, moment / v["If"] - centrifugal + dhinge]


def simulate(v, duration, roll=0.0, pitch=0.0, p=0.0, q=0.0, start=(0.0, 0.0)):
    """Return the mean tilt (right, nose up) [rad] of the disk by turn, for constant input.

    The tilt follows from beta = right sin(chi) + up cos(chi) and its derivative; `start` is (beta,
    dbeta).
    """
    turns = round(duration * v["Omega"] / (2 * np.pi))
    t = np.arange(64 * turns) / 64 * 2 * np.pi / v["Omega"]
    solution = solve_ivp(
        lambda t, y: rates(v, t, y, roll, pitch, p, q),
        (0.0, t[-1]),
        start,
        "DOP853",
        t,
        rtol=1e-9,
        atol=1e-13,
    )
    (beta, dbeta), chi = solution.y, v["Omega"] * t
    right = beta * np.sin(chi) + dbeta / v["Omega"] * np.cos(chi)
    up = beta * np.cos(chi) - dbeta / v["Omega"] * np.sin(chi)
    return np.stack([right, up], axis=1).reshape(turns, 64, 2).mean(axis=1)


def time_constant(v, turns=20):
    """Return the time constant [s] of a bar released at a tilt of 1e-3."""
    duration = turns * 2 * np.pi / v["Omega"]
    size = np.hypot(*simulate(v, duration, start=(1e-3, 0.0)).T)
    return (turns - 1) / turns * duration / np.log(size[0] / size[-1])


def settled_tilt(v, axis="roll"):
    """Return the tilt (right, nose up) per x/L5 after 18 time constants, for "roll" or "pitch"."""
    return simulate(v, 18 * time_constant(v), **{axis: 1e-3})[-1] / 1e-3


def tilt_per_rate(v, axis="p"):
    """Return the settled tilt (right, nose up) [rad] per shaft rate [rad/s], for "p" or "q"."""
    return simulate(v, 18 * time_constant(v), **{axis: 1e-4})[-1] / 1e-4
