"""Records of the roll model from an independent program: scipy and the coefficients of eq. 23."""

from typing import Any

import numpy as np
import scipy.signal

from heli_jax import Flight, Helicopter


def denominators(v: dict[str, float], stand: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return num and den of H(s), from the paper's eq. 23 and the stand's two terms."""
    q = v["rho"] * v["Omega"] ** 2 * v["a"] * v["c"]
    inertia = v["Ixx"] + v.get("Ixx_added", 0.0)
    k1 = q * (v["R2"] ** 4 - v["R1"] ** 4) / (8.0 * v["If"])
    k2 = q * v["R"] ** 4 / (2.0 * inertia * v["L1"] * (v["L2"] + v["L3"]))
    share = v["Ixx"] / inertia if stand else 0.0
    kappa, zeta = v.get("kappa", 0.0) * share, v.get("zeta", 0.0) * share
    c1, c2 = k1 / v["Omega"], v["Omega"] ** 2
    c3 = k1 * k2 * v["L2"] * v["L4"] / v["Omega"]
    num = [k2 * v["L3"], k1 * k2 * v["L3"] / v["Omega"]]
    num.append(k2 * (v["L3"] * c2 + v["L2"] * v["L4"] * k1 / v["L5"]))
    den = np.polymul([1.0, zeta, kappa], [1.0, c1, c2])
    den[3] += c3
    return np.array(num), den


BENCH = {
    "Ixx": 0.024, "If": 0.00017, "a": 5.1, "R": 0.62, "c": 0.045, "R1": 0.13, "R2": 0.21,
    "L1": 0.02, "L2": 0.012, "L3": 0.028, "L4": 0.0087, "L5": 0.02, "Omega": 150.0, "rho": 1.2,
    "kappa": 4.0, "zeta": 0.2,
}  # fmt: skip


def response(v: dict[str, float], u: np.ndarray, dt: float, stand: bool) -> np.ndarray:
    """Return the roll angle (N,) for a held input (N,), from rest."""
    b, a, _ = scipy.signal.cont2discrete(denominators(v, stand), dt)
    return scipy.signal.lfilter(np.ravel(b), a, u)


def steps(rng: np.random.Generator, n: int, dt: float, amplitude: float) -> np.ndarray:
    """Return random steps of 0.2 to 1.5 s."""
    u = np.empty(n)
    k = 0
    while k < n:
        length = int(rng.uniform(0.2, 1.5) / dt) + 1
        u[k : k + length] = amplitude * rng.uniform(-1.0, 1.0)
        k += length
    return u


def amplitude_for(v: dict[str, float], dt: float, stand: bool, rms: float = 0.17) -> float:
    """Return the stick that gives the vehicle a certain rms in a fixed record."""
    u = steps(np.random.default_rng(1), 4000, dt, 1.0)
    return rms / float(np.std(response(v, u, dt, stand)))


def record(
    v: dict[str, float],
    *,
    seed: int,
    n: int = 4000,
    dt: float = 0.02,
    stand: bool = True,
    noise: float = 2e-3,
    amplitude: float | None = None,
    **more: Any,
) -> Flight:
    """Return a roll run with white measurement noise."""
    rng = np.random.default_rng(seed)
    amplitude = amplitude_for(v, dt, stand) if amplitude is None else amplitude
    u = steps(rng, n, dt, amplitude)
    y = response(v, u, dt, stand) + noise * rng.standard_normal(n)
    return Flight(dt=dt, inputs={"x_roll": u}, outputs={"roll": y}, **more)


def stable_geometry(seed: int) -> dict[str, float]:
    """Return constants scattered about the bench vehicle's, stable and not too slow or fast."""
    rng = np.random.default_rng(seed)
    while True:
        v = {k: x * float(np.exp(0.15 * rng.standard_normal())) for k, x in BENCH.items()}
        v["rho"], v["R2"] = 1.2, max(v["R2"], 1.2 * v["R1"])
        free = np.roots(denominators(v, False)[1])
        moving = free[np.abs(free) > 1e-6]
        if np.all(moving.real < -1.0) and np.all(np.roots(denominators(v, True)[1]).real < -0.1):
            return v


def vehicle(v: dict[str, float]) -> Helicopter:
    return Helicopter(**v)
