"""Eqs 11, 12, 14, 21 and 22 from the paper, with NumPy alone, as an independent reference.

A state is (phi, dphi, beta, dbeta); a vehicle is a mapping of the paper's names.
"""

import numpy as np

BENCH = {
    "Ixx": 0.024,
    "If": 0.00017,
    "a": 5.1,
    "R": 0.62,
    "c": 0.045,
    "R1": 0.13,
    "R2": 0.21,
    "L1": 0.02,
    "L2": 0.012,
    "L3": 0.028,
    "L4": 0.0087,
    "L5": 0.02,
    "Omega": 150.0,
    "rho": 1.2,
    "kappa": 4.0,
    "zeta": 0.2,
}


def rates(v, state, x_roll, stand):
    """Return the derivative of the state."""
    phi, phi_dot, beta, beta_dot = state
    Ixx, If, Om = v["Ixx"], v["If"], v["Omega"]
    total = Ixx + v.get("Ixx_added", 0.0)
    # (11): theta_cyc L1 = L3/(L2+L3) x + L2 L4/(L2+L3) beta
    theta_cyc = (
        v["L3"] / (v["L2"] + v["L3"]) * x_roll + v["L2"] * v["L4"] / (v["L2"] + v["L3"]) * beta
    ) / v["L1"]
    # (14), (5): M = 1/2 rho Om^2 a c R^4 theta_cyc
    moment = v.get("cyclic_moment", 0.5) * v["rho"] * Om**2 * v["a"] * v["c"] * v["R"] ** 4
    phi_ddot = moment * theta_cyc / total
    # (12): If b'' + Om^2 If b = 1/8 rho Om^2 a c (x/L5 - (b' + phi')/Om) (R2^4 - R1^4)
    lift = v["rho"] * Om**2 * v["a"] * v["c"] * (v["R2"] ** 4 - v["R1"] ** 4) / 8.0
    beta_ddot = lift * (x_roll / v["L5"] - (beta_dot + phi_dot) / Om) / If - Om**2 * beta
    if stand:  # physical torques of the stand: kappa Ixx and zeta Ixx, on the total inertia
        phi_ddot = phi_ddot - (v["kappa"] * Ixx * phi + v["zeta"] * Ixx * phi_dot) / total
    return np.array([phi_dot, phi_ddot, beta_dot, beta_ddot])


def matrices(v, stand):
    """Return A (4, 4) and B (4, 1), the derivatives at unit states and unit stick."""
    eye = np.eye(4)
    A = np.stack([rates(v, e, 0.0, stand) for e in eye], axis=1)
    return A, rates(v, np.zeros(4), 1.0, stand)[:, None]


def scattered(seed):
    """Return a random vehicle within physical limits."""
    rng = np.random.default_rng(seed)
    v = {k: x * float(np.exp(0.4 * rng.standard_normal())) for k, x in BENCH.items()}
    v["R2"] = v["R1"] * (1.1 + rng.random())
    v["Ixx_added"] = float(rng.choice([0.0, 0.5])) * v["Ixx"]
    return v
