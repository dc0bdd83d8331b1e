"""Speed of sweeps compared with hand-written programs in one run, as a table and a figure.

The work is that of `heli_jax.sweep` from the design to the store on disk: the roll model on its
stand, with the mean square misfit of every vehicle to a record. Each number is the slope between a
small and a large number of vehicles, so that compilation and start-up do not count. Our program and
the C kernel run in turn on the same threads. The best times count, since other load only adds. Our
times include the discretisation of every vehicle, while C is given its coefficients.

    .venv/bin/python experiments/benchmarks/sweeps.py [--quick] [--out runs/benchmarks]

It takes three minutes on two free cores, nine on shared ones. For GPUs see `gpu_sweeps.py`.
"""

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from kernels import WIDE, compiled, pointer

from heli_jax import Flight, load_vehicle, models, sweep
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.naming import replace
from heli_jax.simulation.discretize import discretize
from heli_jax.sweeps import Range, Reduce, sobol

jax.config.update("jax_enable_x64", True)
if __name__ == "__main__":
    jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))

VEHICLE = load_vehicle(Path(__file__).parents[2] / "configs" / "vehicles" / "bench-30.yaml")
DT, SUBSTEPS = 0.02, 4
BACKENDS = ("fused", "xla")
BUILDS = {
    f"{lanes} in flight, {bits} bits": (f"-DLANES={lanes}", *(WIDE if bits == 512 else ()))
    for lanes in (8, 16, 32)
    for bits in (256, 512)
}
"""Builds of the C kernel; the best one is compared."""
CHUNK = {"exact": 65_536, "rk4": 8192, "dask": 4096}
"""Chunk of `sweep` for the larger number. The smaller number needs the same chunk for a correct
slope. With two workers, the chunk for 16 chunks.
"""
REDUCE = {"misfit": Reduce("rmse", "roll")}


class Sizes(NamedTuple):
    """Sizes of the measurements."""

    exact: tuple[int, int]
    rk4: tuple[int, int]
    pairs: int
    batches: tuple[int, ...]
    lengths: tuple[int, ...]
    most: int
    runs: int
    """Repetitions of the largest number and four times as many, in turn; both are whole chunks."""


FULL = Sizes(
    (65_536, 262_144), (8192, 40_960), 7,
    (1, 10, 100, 1000, 10_000, 100_000, 1_000_000), (100, 1000, 10_000, 100_000), 1 << 20, 5,
)  # fmt: skip
QUICK = Sizes((65_536, 131_072), (8192, 16_384), 3, (1, 100, 10_000), (100, 1000), 1 << 17, 2)


def record(samples: int) -> Flight:
    """Return a driven run with 2 mrad of noise."""
    rng = np.random.default_rng(0)
    u = 3e-6 * np.repeat(rng.uniform(-1, 1, -(-samples // 25)), 25)[:samples]
    num, den = roll_transfer_function(VEHICLE, stand=True)
    system: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
    y = scipy.signal.lfilter(np.ravel(system[0]), system[1], u)
    y = y + 2e-3 * rng.standard_normal(samples)
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y}, name="bench")


def design(n: int) -> Any:
    return sobol({"Ixx": Range(0.02, 0.05, "log"), "If": Range(2e-4, 6e-4, "log")}, n)


def seconds(run: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def ours(flight: Flight, n: int, solver: str, **options: Any) -> float:
    """Return the time of a sweep to disk [s]."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "sweep"
        return seconds(
            lambda: sweep(
                models.roll_on_stand, VEHICLE, flight, design(n), REDUCE, out=out, solver=solver,
                substeps=SUBSTEPS, **{"chunk": CHUNK[solver], **options},
            )
        )  # fmt: skip


def in_threads(work: Callable[[int], None], threads: int) -> None:
    running = [threading.Thread(target=work, args=(k,)) for k in range(threads)]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join()


def arrays(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the C kernel's arguments for n vehicles: discrete and continuous coefficients."""
    values = design(n).values(0, n)

    def scalars(Ixx: Any, If: Any) -> Any:
        d = discretize(models.roll_on_stand, replace(VEHICLE, Ixx=Ixx, If=If), jnp.asarray(DT))
        return jnp.concatenate([d.Ad.ravel(), d.Bd.ravel()])

    mapped = jax.jit(lambda v: jax.lax.map(lambda p: scalars(*p), v, batch_size=64))
    coefficients = np.asarray(mapped((values["Ixx"], values["If"]))).T
    v: Any = {k: float(getattr(VEHICLE, k)) for k in VEHICLE.__dataclass_fields__} | values
    q = v["rho"] * v["Omega"] ** 2 * v["a"] * v["c"]
    k1 = q * (v["R2"] ** 4 - v["R1"] ** 4) / (8 * v["If"])
    k2 = q * v["R"] ** 4 / (2 * v["Ixx"] * v["L1"] * (v["L2"] + v["L3"]))
    ones = np.ones(n)
    rows = [k1, ones / v["L5"], ones / v["Omega"], v["Omega"] ** 2 * ones, k2 * v["L3"]]
    rows += [k2 * v["L2"] * v["L4"], v["kappa"] * ones, v["zeta"] * ones]
    return coefficients, np.array(rows)


def in_c(
    kernel: Any,
    flight: Flight,
    solver: str,
    coefficients: tuple[np.ndarray, np.ndarray],
    threads: int,
) -> Callable[[], np.ndarray]:
    """Return a function that runs the C kernel on all vehicles and returns mean squares."""
    matrix = coefficients[0] if solver == "exact" else coefficients[1]
    parts = [np.ascontiguousarray(p) for p in np.array_split(matrix, threads, axis=1)]
    costs = [np.zeros(p.shape[1]) for p in parts]
    u, y, size = flight.inputs["x_roll"], flight.outputs["roll"], ctypes.c_size_t

    def work(k: int) -> None:
        common = (pointer(parts[k]), pointer(u), pointer(y), pointer(costs[k]))
        counts = (size(parts[k].shape[1]), size(u.size))
        if solver == "exact":
            kernel.exact(*common, *counts)
        else:
            kernel.rk4(*common, *counts, ctypes.c_double(DT), ctypes.c_int(SUBSTEPS))

    def run() -> np.ndarray:
        in_threads(work, threads)
        return np.concatenate(costs)

    return run


def against_c(
    kernels: list[Any],
    flight: Flight,
    solver: str,
    sizes: tuple[int, int],
    pairs: int,
    devices: list[Any],
) -> list[float]:
    """Return microseconds per vehicle of our backends, then of each kernel, measured in turn."""
    small, large = sizes
    coefficients = arrays(large)
    few = (coefficients[0][:, :small], coefficients[1][:, :small])
    kernel_runs = [
        [in_c(kernel, flight, solver, some, len(devices)) for some in (few, coefficients)]
        for kernel in kernels
    ]
    for run, _ in kernel_runs:
        check(flight, solver, run())
    for backend in BACKENDS:
        ours(flight, small, solver, devices=devices, backend=backend)
    best = np.full((len(BACKENDS) + len(kernels), 2), np.inf)
    for _ in range(pairs):
        for k, n in enumerate(sizes):
            for i, backend in enumerate(BACKENDS):
                taken = ours(flight, n, solver, devices=devices, backend=backend)
                best[i, k] = min(best[i, k], taken)
            for i, runs in enumerate(kernel_runs, len(BACKENDS)):
                best[i, k] = min(best[i, k], seconds(runs[k]))
    return [float(v) for v in 1e6 * (best[:, 1] - best[:, 0]) / (large - small)]


def check(flight: Flight, solver: str, cost: np.ndarray) -> None:
    """Check that both give the same numbers."""
    dataset = sweep(
        models.roll_on_stand, VEHICLE, flight, design(cost.size), REDUCE, solver=solver,
        substeps=SUBSTEPS, chunk=CHUNK[solver],
    )  # fmt: skip
    np.testing.assert_allclose(dataset["misfit"].to_numpy() ** 2, cost, rtol=1e-6)


def in_numpy(flight: Flight, coefficients: np.ndarray, n: int) -> Callable[[], np.ndarray]:
    """Return the recurrence in NumPy, for all vehicles at once."""
    A, B = coefficients[:16, :n].reshape(4, 4, n), coefficients[16:, :n]
    u, y = flight.inputs["x_roll"], flight.outputs["roll"]

    def run() -> np.ndarray:
        x, cost = np.zeros((4, n)), np.zeros(n)
        for k in range(u.size):
            cost += (y[k] - x[0]) ** 2
            x = np.einsum("ijn,jn->in", A, x) + B * u[k]
        return cost / u.size

    return run


def in_scipy(flight: Flight, n: int) -> Callable[[], np.ndarray]:
    """Return SciPy's cont2discrete and lfilter, vehicle by vehicle."""
    values = design(n).values(0, n)
    u, y = flight.inputs["x_roll"], flight.outputs["roll"]

    def run() -> np.ndarray:
        cost = np.zeros(n)
        for k in range(n):
            v = replace(VEHICLE, Ixx=float(values["Ixx"][k]), If=float(values["If"][k]))
            num, den = roll_transfer_function(v, stand=True)
            system: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
            simulated = scipy.signal.lfilter(np.ravel(system[0]), system[1], u)
            cost[k] = np.mean((y - simulated) ** 2)
        return cost

    return run


def in_numba(
    flight: Flight, coefficients: np.ndarray, threads: int
) -> Callable[[], np.ndarray] | None:
    """Return the C kernel's loops in Numba; None if it is not installed."""
    try:
        import numba
    except ImportError:
        return None

    @numba.njit(fastmath=True, nogil=True)
    def loops(c: Any, u: Any, y: Any, cost: Any) -> None:
        for v in range(cost.size):
            x0 = x1 = x2 = x3 = total = 0.0
            for k in range(u.size):
                e = y[k] - x0
                total += e * e
                n0 = c[0, v] * x0 + c[1, v] * x1 + c[2, v] * x2 + c[3, v] * x3 + c[16, v] * u[k]
                n1 = c[4, v] * x0 + c[5, v] * x1 + c[6, v] * x2 + c[7, v] * x3 + c[17, v] * u[k]
                n2 = c[8, v] * x0 + c[9, v] * x1 + c[10, v] * x2 + c[11, v] * x3 + c[18, v] * u[k]
                n3 = c[12, v] * x0 + c[13, v] * x1 + c[14, v] * x2 + c[15, v] * x3 + c[19, v] * u[k]
                x0, x1, x2, x3 = n0, n1, n2, n3
            cost[v] = total / u.size

    parts = [np.ascontiguousarray(p) for p in np.array_split(coefficients, threads, axis=1)]
    costs = [np.zeros(p.shape[1]) for p in parts]
    u, y = np.array(flight.inputs["x_roll"]), np.array(flight.outputs["roll"])

    def run() -> np.ndarray:
        in_threads(lambda k: loops(parts[k], u, y, costs[k]), threads)
        return np.concatenate(costs)

    return run


def per_vehicle(run: Callable[[], Any], n: int, times: int = 3) -> float:
    """Return microseconds per vehicle, the best of some runs after a first one."""
    run()
    return 1e6 * min(seconds(run) for _ in range(times)) / n


def slopes(
    flight: Flight, sizes: tuple[int, int], solver: str, ways: list[dict[str, Any]]
) -> list[float]:
    """Return microseconds per vehicle of each way, in turn, as the slope of the best times."""
    for way in ways:
        ours(flight, sizes[0], solver, **way)
    best = [[np.inf, np.inf] for _ in ways]
    for _ in range(5):
        for times, way in zip(best, ways, strict=True):
            for k, n in enumerate(sizes):
                times[k] = min(times[k], ours(flight, n, solver, **way))
    return [1e6 * (large - small) / (sizes[1] - sizes[0]) for small, large in best]


def threads_over_one(kernel: Any, flight: Flight, solver: str, n: int, threads: int) -> float:
    """Return the C kernel's speed-up by its threads, the best of five in turn."""
    coefficients = arrays(n)
    ways = [in_c(kernel, flight, solver, coefficients, k) for k in (1, threads)]
    best = [np.inf, np.inf]
    for _ in range(5):
        best = [min(was, seconds(run)) for was, run in zip(best, ways, strict=True)]
    return best[0] / best[1]


def by_length(N: int) -> float:
    """Return microseconds per vehicle of N samples, with enough vehicles to hide start-up."""
    n = min(100_000_000 // N, 131_072)
    return slopes(record(N), (n, 4 * n), "exact", [{"chunk": min(n, 32_768)}])[0]


def on_workers(flight: Flight, n: int, workers: int) -> float:
    """Return microseconds per vehicle on a local dask cluster: slope, best of three sweeps."""
    from distributed import LocalCluster

    from heli_jax.sweeps.cluster import connected

    best = np.inf
    local = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0")
    with local, connected(local.scheduler_address) as client:
        for _ in range(3):
            seen: list[tuple[float, int]] = []
            ours(
                flight, n, "rk4", client=client, chunk=CHUNK["dask"],
                progress=lambda done, _, seen=seen: seen.append((time.perf_counter(), done)),
            )  # fmt: skip
            t0, n0 = next(s for s in seen if s[1] >= n / 4)
            t1, n1 = seen[-1]
            best = min(best, 1e6 * (t1 - t0) / (n1 - n0))
    return best


def memory_of(n: int) -> float:
    """Return the peak resident memory [MB] of a sweep of 1000 samples, in a process of its own."""
    program = [sys.executable, __file__, "--memory", str(n)]
    run = subprocess.run(program, capture_output=True, text=True, check=True)
    return float(run.stdout)


def memory(n: int) -> None:
    ours(record(1000), n, "exact")
    # getrusage would include the memory of the parent process.
    held = next(v for v in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in v)
    print(int(held.split()[1]) / 1024)


def linearity(n: int, times: int) -> float:
    """Return time per vehicle of 4 n over that of n, from the best times in turn.

    Both exceed one chunk, so that start-up does not count.
    """
    flight, chunk = record(1000), CHUNK["exact"]
    best = dict.fromkeys((chunk, n, 4 * n), np.inf)
    ours(flight, n, "exact")
    for _ in range(times):
        best = {k: min(t, ours(flight, k, "exact")) for k, t in best.items()}
    small, large = ((best[k] - best[chunk]) / (k - chunk) for k in (n, 4 * n))
    return large / small


def table(rows: list[tuple[str, str, str]]) -> None:
    for what, value, target in rows:
        print(f"{what:62s} {value:>28s}  {target}")


def on_cpu(sizes: Sizes) -> tuple[list[tuple[str, str, str]], dict[str, Any]]:
    devices, flight = jax.local_devices(), record(6000)
    threads, kernels = len(devices), [compiled("kernel.c", flags) for flags in BUILDS.values()]
    rows: list[tuple[str, str, str]] = []
    drawn: dict[str, Any] = {"throughput": {}}
    for solver in ("exact", "rk4"):
        pair = sizes.exact if solver == "exact" else sizes.rk4
        found = against_c(kernels, flight, solver, pair, sizes.pairs, devices)
        us, in_c = found[: len(BACKENDS)], dict(zip(BUILDS, found[len(BACKENDS) :], strict=True))
        best = min(in_c, key=lambda name: in_c[name])
        for backend, value in zip(BACKENDS, us, strict=True):
            target = "<= 1.3" if backend == "fused" else ""
            what = f"{solver}, {backend}, {threads} threads: time / the best C's"
            rows.append((what, f"{value / in_c[best]:.2f}", target))
            rows.append(("    a vehicle [us]", f"{value:.2f}", ""))
        for name, value in in_c.items():
            rows.append((f"    C, {name}: a vehicle [us]", f"{value:.2f}", ""))
        drawn["throughput"] |= {
            f"{solver}, {b}": value for b, value in zip(BACKENDS, us, strict=True)
        }
        drawn["throughput"][f"{solver} in C, {best}"] = in_c[best]
    coefficients, few = arrays(4096)[0], 256
    others = {
        "exact in NumPy, one thread": (in_numpy(flight, coefficients, 4096), 4096, 1),
        "exact in SciPy, one thread": (in_scipy(flight, few), few, 1),
    }
    numba = in_numba(flight, coefficients, threads)
    if numba is not None:
        others["exact in Numba"] = (numba, 4096, 3)
    for name, (run, n, times) in others.items():
        us = per_vehicle(run, n, times)
        rows.append((f"{name}: a vehicle [us]", f"{us:.1f}", ""))
        drawn["throughput"][name] = us
    for solver in ("exact", "rk4"):
        pair = sizes.exact if solver == "exact" else sizes.rk4
        one, every = slopes(flight, pair, solver, [{"devices": d} for d in (devices[:1], devices)])
        value = f"{one / every:.2f}"
        rows.append((f"{solver}: {threads} devices over one", value, ">= 1.7 for two"))
        value = f"{threads_over_one(kernels[3], flight, solver, pair[0], threads):.2f}"
        rows.append((f"    {threads} threads over one in C, on this machine", value, ""))
    one, two = (on_workers(flight, 16 * CHUNK["dask"], k) for k in (1, 2))
    rows.append(("rk4: two dask workers, of ideal", f"{100 * one / two / 2:.0f} %", ">= 80 %"))
    drawn["batch"] = {n: ours_at(record(1000), n) for n in sizes.batches}
    drawn["length"] = {N: by_length(N) for N in sizes.lengths}
    what = f"{sizes.most} vehicles x 1000 samples"
    rows.append((f"{what}: peak memory", f"{memory_of(sizes.most):.0f} MB", "< 1 GB"))
    linear = f"{linearity(sizes.most, sizes.runs):.3f}"
    rows.append(("    time a vehicle of four times as many, over that", linear, "0.9 to 1.1"))
    return rows, drawn


def ours_at(flight: Flight, n: int) -> float:
    """Return microseconds per vehicle of a whole sweep of n in memory, already compiled."""

    def run() -> None:
        sweep(models.roll_on_stand, VEHICLE, flight, design(n), REDUCE)

    run()
    return 1e6 * seconds(run) / n


def draw(path: Path, drawn: dict[str, Any]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 4), layout="constrained")
    axes = figure.subplots(1, 3)
    names = sorted(drawn.get("throughput", {}), key=lambda n: drawn["throughput"][n])
    axes[0].barh(names, [drawn["throughput"][n] for n in names])
    axes[0].set(xscale="log", xlabel="a vehicle of 6000 samples [µs]")
    for ax, key, text in ((axes[1], "batch", "vehicles of 1000 samples"),
                          (axes[2], "length", "samples")):  # fmt: skip
        points = drawn.get(key, {})
        ax.loglog(list(points), list(points.values()), "o-")
        ax.set(xlabel=text, ylabel="a vehicle [µs]")
        ax.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    print(f"figure: {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    parser.add_argument("--out", default="runs/benchmarks", help="folder of the figure")
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory:
        memory(options.memory)
        return
    sizes = QUICK if options.quick else FULL
    print(f"jax {jax.__version__}, {jax.local_devices()[0].device_kind}, 6000 samples")
    rows, drawn = on_cpu(sizes)
    table(rows)
    if options.quick:
        print("quick: so small that start-up counts; only a whole run gives figures")
    draw(Path(options.out) / "sweeps.png", drawn)


if __name__ == "__main__":
    main()
