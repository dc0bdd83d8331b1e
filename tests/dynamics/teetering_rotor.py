"""Blade elements of a teetering rotor of two blades in the rotating frame, with NumPy alone.

The azimuth psi counts counter-clockwise seen from above, from the tail. One blade is beta above the
hub's plane and the other below; the tip-path plane is beta = -a1 cos psi - b1 sin psi. The shaft
may turn at steady rates p and q and move through the air at (forward, right).
"""

import numpy as np

X, WEIGHT = np.polynomial.legendre.leggauss(8)


def flap_moment(v, psi, beta, dbeta, flight):
    """Return the moment of the air on one blade about the hub [N m]."""
    r, weight = (X + 1) * v["B"] * v["R"] / 2, WEIGHT * v["B"] * v["R"] / 2
    sin, cos = np.sin(psi), np.cos(psi)
    theta = flight["theta0"] + flight["pitch"] * sin - flight["roll"] * cos
    tangential = v["Omega"] * r + flight["forward"] * sin + flight["right"] * cos
    outward = flight["forward"] * cos - flight["right"] * sin
    rising = dbeta - flight["q"] * cos - flight["p"] * sin
    through = flight["inflow"] + r * rising + beta * outward
    lift = v["rho"] * v["c"] * v["a"] / 2 * (tangential**2 * theta - tangential * through)
    return float(weight @ (lift * r))


STILL = dict.fromkeys(("theta0", "pitch", "roll", "forward", "right", "inflow", "p", "q"), 0.0)


def simulate(v, turns, tilt=(0.0, 0.0), **flight):
    """Return the mean tilt (a1, b1) [rad] of each turn, (turns, 2), from an initial tilt."""
    flight, Om, steps = STILL | flight, v["Omega"], 48
    h = 2 * np.pi / Om / steps

    def rates(t, y):
        psi, (beta, dbeta) = Om * t, y
        pair = flap_moment(v, psi, beta, dbeta, flight)
        pair = (pair - flap_moment(v, psi + np.pi, -beta, -dbeta, flight)) / 2
        turning = 2 * Om * (flight["p"] * np.cos(psi) - flight["q"] * np.sin(psi))
        stiff = Om**2 + v["k_beta"] / v["I_beta"]
        return np.array([dbeta, pair / v["I_beta"] - stiff * beta + turning])

    y, found = np.array([-tilt[0], -Om * tilt[1]]), []
    for k in range(turns * steps):
        t, psi = k * h, 2 * np.pi * k / steps
        a1 = -y[0] * np.cos(psi) + y[1] / Om * np.sin(psi)
        b1 = -y[0] * np.sin(psi) - y[1] / Om * np.cos(psi)
        found.append((a1, b1))
        k1 = rates(t, y)
        k2 = rates(t + h / 2, y + h / 2 * k1)
        k3 = rates(t + h / 2, y + h / 2 * k2)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(t + h, y + h * k3))
    return np.reshape(found, (turns, steps, 2)).mean(axis=1)
