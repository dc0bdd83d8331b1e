"""Blade-element theory by quadrature, which eqs 10, 13, 14 and 15 approximate in closed form.

The azimuth psi counts counter-clockwise seen from above, from the tail: 90 degrees is right. Radii
are in R, speeds in R Omega. The blade pitch is theta0 + theta_s sin psi + theta_c cos psi. The
flight direction chi is counter-clockwise from the nose (to the right: -90 degrees); the inflow lam
is uniform. Nose-up cyclic is theta_s > 0, roll-right cyclic is theta_c < 0. Stall and reversed flow
are neglected.
"""

import numpy as np


def _mean(integrand, B, n_r=8, n_psi=64):
    """Return the integral over r (Gauss-Legendre) to B of the mean over psi (trapezoid rule)."""
    x, weight = np.polynomial.legendre.leggauss(n_r)
    r, psi = np.meshgrid((x + 1) * B / 2, np.arange(n_psi) * 2 * np.pi / n_psi, indexing="ij")
    return float(weight @ integrand(r, psi).mean(axis=1)) * B / 2


def _pitch_and_flow(r, psi, theta0, theta_s, theta_c, mu, chi):
    pitch = theta0 + theta_s * np.sin(psi) + theta_c * np.cos(psi)
    return pitch, r + mu * np.sin(psi - chi)


def thrust_coefficient(a, sigma, theta0, lam, mu=0.0, theta_s=0.0, theta_c=0.0, chi=0.0, B=0.97):
    """Return C_T = T / (rho pi R^4 Omega^2). Lift per unit of span is U_T^2 (pitch - lam/U_T)."""

    def lift(r, psi):
        pitch, flow = _pitch_and_flow(r, psi, theta0, theta_s, theta_c, mu, chi)
        return flow**2 * pitch - flow * lam

    return a * sigma / 2 * _mean(lift, B)


def induced_torque_coefficient(
    a, sigma, theta0, lam, mu=0.0, theta_s=0.0, theta_c=0.0, chi=0.0, B=0.97
):
    """Return the induced part of C_Q = Q / (rho pi R^5 Omega^2): tilted lift at arm r."""

    def torque(r, psi):
        pitch, flow = _pitch_and_flow(r, psi, theta0, theta_s, theta_c, mu, chi)
        return r * lam * (flow * pitch - lam)

    return a * sigma / 2 * _mean(torque, B)


def rotor_moment_coefficient(theta_cyc, omega_per_Omega, theta0=0.1, lam=0.05, B=1.0):
    """Return M / (rho Omega^2 a c R^4), averaged over a turn, of two blades fixed to a rigid hub.

    M and the body rate omega are about one axis in the disk, from which psi counts. A blade's arm
    is r sin psi, and it rises at omega r sin psi. Its pitch is theta0 + theta_cyc sin psi.
    """

    def moment(r, psi):
        both = 0.0
        for at in (psi, psi + np.pi):
            pitch = theta0 + theta_cyc * np.sin(at)
            through = lam + omega_per_Omega * r * np.sin(at)
            both = both + (r**2 * pitch - r * through) / 2 * r * np.sin(at)
        return both

    return _mean(moment, B)
