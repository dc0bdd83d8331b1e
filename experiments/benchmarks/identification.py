"""Speed compared with hand-written programs in one run: `make bench`.

All programs run on one core (the process is pinned if the system allows it), each pair in turn. The
result is the ratio of the best times, since other load only adds. The optimum is searched from the
same start, with the final Jacobian on both sides. The whole of `fit` adds two verdicts, the noise,
metrics, whiteness and tables, which SciPy lacks. Simulations include the discretisation of every
vehicle, while the C kernel is given its coefficients.
"""

import ctypes
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.signal
from kernels import compiled, pointer

from heli_jax import (
    Flight,
    Free,
    Nuisance,
    Prior,
    Problem,
    accumulate,
    fit,
    load_vehicle,
    models,
    rls,
)
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.levenberg_marquardt import optimise
from heli_jax.identification.unknowns.layout import Noise, layout_of
from heli_jax.naming import replace

jax.config.update("jax_enable_x64", True)
HERE = Path(__file__).parent
VEHICLE = load_vehicle(HERE.parents[1] / "configs" / "vehicles" / "bench-30.yaml")
N, DT, BATCH, BLOCK, SUBSTEPS = 6000, 0.02, 1024, 128, 4
TURNS = 15
"""Repetitions of each pair."""


def closed_form(v: dict[str, float]) -> tuple[list[float], np.ndarray]:
    """Return H(s) of eq. 23 on the stand in plain Python."""
    q = v["rho"] * v["Omega"] ** 2 * v["a"] * v["c"]
    k1 = q * (v["R2"] ** 4 - v["R1"] ** 4) / (8 * v["If"])
    k2 = q * v["R"] ** 4 / (2 * v["Ixx"] * v["L1"] * (v["L2"] + v["L3"]))
    c1, c2, c3 = k1 / v["Omega"], v["Omega"] ** 2, k1 * k2 * v["L2"] * v["L4"] / v["Omega"]
    num = [k2 * v["L3"], k1 * k2 * v["L3"] / v["Omega"]]
    num.append(k2 * (v["L3"] * c2 + v["L2"] * v["L4"] * k1 / v["L5"]))
    den = np.polymul([1.0, v["zeta"], v["kappa"]], [1.0, c1, c2])
    den[3] += c3
    return num, den


def bench_record() -> Flight:
    """Return 6000 samples at 50 Hz with 2 mrad of white noise."""
    rng = np.random.default_rng(0)
    u = 3e-6 * np.repeat(rng.uniform(-1, 1, N // 25), 25)
    num, den = roll_transfer_function(VEHICLE, stand=True)
    discrete: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
    b, a = discrete[:2]
    y = scipy.signal.lfilter(np.ravel(b), a, u) + 2e-3 * rng.standard_normal(N)
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})


def ratios(ours: Callable[[], Any], theirs: Callable[[], Any], times: int = 1) -> tuple[float, ...]:
    """Return the best times of both [s], measured in turn, and their ratio."""
    ours()
    theirs()
    best = [np.inf, np.inf]
    for _ in range(times * TURNS):
        for i, f in enumerate((ours, theirs)):
            begin = time.perf_counter()
            jax.block_until_ready(f())
            best[i] = min(best[i], time.perf_counter() - begin)
    return best[0], best[1], best[0] / best[1]


def fit_against_scipy(flight: Flight) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Compare the optimum from the same start, and the whole of `fit`, with SciPy's optimum."""
    free = {"Ixx": Free(0.05), "If": Free(5e-4), "a": Free(5.0, prior=Prior(5.5, 0.5))}
    problem = Problem(models.roll_on_stand, VEHICLE, [flight], free, Nuisance(False, False))
    base = {n: float(getattr(VEHICLE, n)) for n in VEHICLE.__dataclass_fields__}
    u, y = flight.inputs["x_roll"], flight.outputs["roll"]

    def residual(z: np.ndarray) -> np.ndarray:
        v: Any = base | dict(zip(("Ixx", "If", "a"), np.exp(z), strict=True))
        discrete: Any = scipy.signal.cont2discrete(closed_form(v), DT)
        b, a = discrete[:2]
        r = (y - scipy.signal.lfilter(np.ravel(b), a, u)) / 2e-3
        return np.append(r, (v["a"] - 5.5) / 0.5)

    start = np.log([0.05, 5e-4, 5.0])
    result = fit(problem)
    theirs = scipy.optimize.least_squares(residual, start, x_scale="jac", ftol=1e-10, xtol=1e-10)
    ours = np.array([e.value for e in result.estimates.values()])
    assert np.allclose(ours, np.exp(theirs.x), rtol=1e-3), (ours, np.exp(theirs.x))

    def scipys() -> Any:
        return scipy.optimize.least_squares(residual, start, x_scale="jac", ftol=1e-10, xtol=1e-10)

    layout, data = layout_of(problem, (flight,)), data_of(problem, (flight,))
    z = start_vector(layout, data, problem)
    noise = Noise(({"roll": np.asarray(2e-3)},), np.zeros(()))
    assert np.allclose(np.exp(optimise(layout, data, noise, z).z), np.exp(theirs.x), rtol=1e-3)
    optimum = ratios(lambda: optimise(layout, data, noise, z).z, scipys, times=4)
    return optimum, ratios(lambda: fit(problem), scipys)


def rls_against_numpy(flight: Flight) -> tuple[float, ...]:
    u, y = flight.inputs["x_roll"] * 1e6, flight.outputs["roll"]
    uj, yj = jnp.asarray(u), jnp.asarray(y)

    def loop() -> np.ndarray:
        theta, P = np.zeros(9), 1e6 * np.eye(9)
        for k in range(4, N):
            phi = np.concatenate([y[k - 4 : k][::-1], u[k - 4 : k + 1][::-1]])
            g = P @ phi
            alpha = 1.0 + phi @ g
            theta = theta + g / alpha * (y[k] - phi @ theta)
            P = P - np.outer(g, g) / alpha
        return theta

    assert np.allclose(rls(uj, yj).theta, loop(), rtol=1e-4)
    return ratios(lambda: rls(uj, yj).theta, loop)


def batched(flight: Flight, Ixx: jax.Array, solver: str) -> Callable[[], jax.Array]:
    """Return the mean-square misfit of each vehicle, in blocks, without storing runs."""
    u = models.roll_on_stand.Inputs(x_roll=jnp.asarray(flight.inputs["x_roll"]))
    y = jnp.asarray(flight.outputs["roll"])

    def misfit(i: jax.Array) -> jax.Array:
        total, _ = accumulate(
            models.roll_on_stand,
            replace(VEHICLE, Ixx=i),
            u,
            lambda total, out, measured: total + (measured - out.roll) ** 2,
            jnp.zeros(()),
            data=y,
            dt=jnp.asarray(DT),
            solver=solver,
            substeps=SUBSTEPS,
            adjoint=diffrax.ForwardMode(),
        )
        return total / N

    run = jax.jit(lambda Ixx: jax.lax.map(misfit, Ixx, batch_size=BLOCK))
    return lambda: run(Ixx)


def simulation_against_c(flight: Flight, solver: str) -> tuple[float, ...]:
    kernel = compiled("kernel.c")
    Ixx = np.linspace(0.5, 2.0, BATCH) * float(VEHICLE.Ixx)
    u, y = flight.inputs["x_roll"], flight.outputs["roll"]
    cost = np.zeros(BATCH)

    size = ctypes.c_size_t
    if solver == "exact":
        from heli_jax.simulation.discretize import discretize

        def scalars(i: jax.Array) -> jax.Array:
            d = discretize(models.roll_on_stand, replace(VEHICLE, Ixx=i), jnp.asarray(DT))
            return jnp.concatenate([d.Ad.ravel(), d.Bd.ravel()])

        coef = np.ascontiguousarray(np.asarray(jax.vmap(scalars)(jnp.asarray(Ixx))).T)

        def theirs() -> np.ndarray:
            kernel.exact(pointer(coef), pointer(u), pointer(y), pointer(cost), size(BATCH), size(N))
            return cost
    else:
        v = {n: float(getattr(VEHICLE, n)) for n in VEHICLE.__dataclass_fields__}
        q = v["rho"] * v["Omega"] ** 2 * v["a"] * v["c"]
        k1 = q * (v["R2"] ** 4 - v["R1"] ** 4) / (8 * v["If"])
        k2 = q * v["R"] ** 4 / (2 * Ixx * v["L1"] * (v["L2"] + v["L3"]))
        ones = np.ones(BATCH)
        rows = [k1 * ones, ones / v["L5"], ones / v["Omega"], v["Omega"] ** 2 * ones, k2 * v["L3"]]
        rows += [k2 * v["L2"] * v["L4"], v["kappa"] * ones, v["zeta"] * ones]
        par = np.ascontiguousarray(np.array(rows))

        def theirs() -> np.ndarray:
            kernel.rk4(
                pointer(par), pointer(u), pointer(y), pointer(cost), size(BATCH), size(N),
                ctypes.c_double(DT), ctypes.c_int(SUBSTEPS),
            )  # fmt: skip
            return cost

    ours = batched(flight, jnp.asarray(Ixx), solver)
    assert np.allclose(ours(), theirs(), rtol=1e-6)
    return ratios(ours, theirs)


def main() -> None:
    flight = bench_record()
    optimum, whole = fit_against_scipy(flight)
    rows = [
        ("three-parameter optimum / scipy least_squares", optimum, "<= 0.20"),
        ("whole fit() with verdict / scipy least_squares", whole, ""),
        ("RLS / numpy loop", rls_against_numpy(flight), "<= 0.02"),
        (f"exact, {BATCH} vehicles / C", simulation_against_c(flight, "exact"), "<= 2.5"),
        (f"RK4 x{SUBSTEPS}, {BATCH} vehicles / C", simulation_against_c(flight, "rk4"), "<= 2.0"),
    ]
    print(f"{N} samples, one core, jax {jax.__version__}")
    print(f"{'':47s} {'ours [ms]':>10s} {'other [ms]':>10s} {'ratio':>8s}  target")
    for name, (a, b, ratio), target in rows:
        print(f"{name:47s} {1e3 * a:10.2f} {1e3 * b:10.2f} {ratio:8.4f}  {target}")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from script import Size, asked

    TURNS = asked(__doc__, "some minutes", Size("turns", 15, 1, "how often each is timed")).turns
    main()
