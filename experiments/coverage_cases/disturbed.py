"""The disturbed bench, simulated from the paper's equations with SciPy alone; it has no case."""

import numpy as np
import scipy.linalg

from coverage_cases import Case
from heli_jax import Helicopter


def matrices(v: Helicopter) -> tuple[np.ndarray, np.ndarray]:
    """Return A (4, 4) and B (4,) of eqs 21-22 on the stand.

    The state is roll and its rate, the flybar's angle and its rate.
    """
    names = ("a", "R", "c", "R1", "R2", "L1", "L2", "L3", "L4", "L5", "Omega", "rho", "Ixx", "If")
    g = {n: float(getattr(v, n)) for n in names}
    force = g["rho"] * g["Omega"] ** 2 * g["a"] * g["c"]
    mixing = 0.5 * force * g["R"] ** 4 / (g["Ixx"] * g["L1"] * (g["L2"] + g["L3"]))
    lift = force * (g["R2"] ** 4 - g["R1"] ** 4) / (8.0 * g["If"])
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1] = [-float(v.kappa), -float(v.zeta), mixing * g["L2"] * g["L4"], 0.0]
    A[3] = [0.0, -lift / g["Omega"], -(g["Omega"] ** 2), -lift / g["Omega"]]
    return A, np.array([0.0, mixing * g["L3"], 0.0, lift / g["L5"]])


def response(
    v: Helicopter, u: np.ndarray, dt: float, sigma: float, tau: float, rng: np.random.Generator
) -> np.ndarray:
    """Return states (N, 5) from rest; the last is an Ornstein-Uhlenbeck roll acceleration.

    They are exact from sample to sample (Van Loan, 1978), and the disturbance is stationary.
    """
    A, B = np.zeros((5, 5)), np.zeros((5, 1))
    A[:4, :4], B[:4, 0] = matrices(v)
    A[1, 4], A[4, 4] = 1.0, -1.0 / tau
    G = np.zeros((5, 5))
    G[4, 4] = 2.0 * sigma**2 / tau
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 6))]]) * dt)
    Ad, Bd = held[:5, :5], held[:5, 5]
    both = scipy.linalg.expm(np.block([[-A, G], [np.zeros((5, 5)), A.T]]) * dt)
    values, vectors = np.linalg.eigh(both[5:, 5:].T @ both[:5, 5:])
    noise = rng.standard_normal((u.size, 5)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    x, states = np.array([0.0, 0.0, 0.0, 0.0, sigma * rng.standard_normal()]), []
    for push, kick in zip(u, noise, strict=True):
        states.append(x)
        x = Ad @ x + Bd * push + kick
    return np.array(states)


def cases() -> list[Case]:
    return []
