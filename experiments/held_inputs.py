"""Bias of If from resampling a held input in different ways.

    .venv/bin/python experiments/held_inputs.py [RUNS]

SciPy simulates the roll stand (eqs 21-22, by hand) in steps of 1 ms, with a stick that steps at any
of them. It is logged at 100 Hz with a jitter of a fifth of a step. Each log is fitted by output
error at 50 and 100 Hz, in three ways: with the stick's value at the grid's times, with its mean
over the grid's steps, and with the mean and a free time shift. A second stick steps at the log's
stamps, so it is logged when it acts. The first is 5 ms late on average in any log. The table has
the mean error of If in percent, its chance deviation from zero, and the mean shift.
"""

import dataclasses
import math
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import scipy.signal

from heli_jax import Flight, Free, Nuisance, Problem, fit, models
from heli_jax.flights import Signal, read_flight
from heli_jax.vehicle import Helicopter

jax.config.update("jax_enable_x64", True)

TRUTH = {"Ixx": 0.0262, "If": 1.9e-4}
KNOWN = {
    "a": 5.4, "kappa": 4.5, "zeta": 0.25, "rho": 1.19, "c": 0.045, "R": 0.62, "R1": 0.13,
    "R2": 0.21, "L1": 0.02, "L2": 0.012, "L3": 0.028, "L4": 0.0087, "L5": 0.02, "Omega": 152.0,
}  # fmt: skip
LENGTH, STEP, RATE, JITTER, NOISE = 20.0, 1e-3, 100.0, 0.2, 2e-3


def dynamics() -> tuple[np.ndarray, np.ndarray]:
    """Return A (4, 4) and B (4, 1) of phi, dphi, beta, dbeta on the stand."""
    k = KNOWN
    paddle = k["rho"] * k["a"] * k["c"] * (k["R2"] ** 4 - k["R1"] ** 4) / (8 * TRUTH["If"])
    k1 = paddle * k["Omega"] ** 2
    moment = 0.5 * k["rho"] * k["Omega"] ** 2 * k["a"] * k["c"] * k["R"] ** 4
    k2 = moment / (TRUTH["Ixx"] * k["L1"] * (k["L2"] + k["L3"]))
    A = np.array(
        [
            [0, 1, 0, 0],
            [-k["kappa"], -k["zeta"], k2 * k["L2"] * k["L4"], 0],
            [0, 0, 0, 1],
            [0, -k1 / k["Omega"], -(k["Omega"] ** 2), -k1 / k["Omega"]],
        ]
    )
    return A, np.array([[0], [k2 * k["L3"]], [0], [k1 / k["L5"]]])


def record(rng: np.random.Generator, with_stamps: bool) -> tuple[np.ndarray, ...]:
    """Return stamps [s], stick [m] and roll [rad] of a log, each (N,).

    Args:
        rng: generator for steps, jitter and noise.
        with_stamps: True if the stick steps at the log's own stamps.
    """
    n = round(LENGTH / STEP)
    count = int(LENGTH * RATE) - 1
    stamps = (np.arange(count) + rng.uniform(-JITTER, JITTER, count)) / RATE + 1 / RATE
    rows = np.round(stamps / STEP).astype(int)
    edges = np.cumsum(rng.integers(200, 800, 2 * int(LENGTH)))
    if with_stamps:
        edges = np.unique(rows[np.clip(np.searchsorted(rows, edges), 0, count - 1)])
    levels = 2e-6 * rng.uniform(-1, 1, edges.size + 1)
    stick = levels[np.searchsorted(edges, np.arange(n), side="right")]
    # Any: the stubs support only transfer functions here.
    signal: Any = scipy.signal
    A, B, *_ = signal.cont2discrete((*dynamics(), np.eye(4), np.zeros((4, 1))), STEP)
    states = signal.dlsim((A, B, np.eye(4), np.zeros((4, 1)), STEP), stick)[2]
    noisy = states[rows, 0] + NOISE * rng.standard_normal(count)
    return rows * STEP, stick[rows], noisy


def flights(rows: np.ndarray, rate: float, folder: Path) -> dict[str, Flight]:
    """Return a log's flight as read, and with the stick's value at the grid's times.

    Args:
        rows: stamps, stick, roll (N, 3).
        rate: rate of the fit [Hz].
        folder: folder for the log.
    """
    path = folder / "log.csv"
    np.savetxt(path, rows, delimiter=",", header="t,stick,phi", comments="", fmt="%.9g")
    signals: Any = {
        "inputs": {"x_roll": Signal("stick", "m", "m", hold="zero-order")},
        "outputs": {"roll": Signal("phi", "rad", "rad")},
    }
    read = read_flight(path, time="t", rate=rate, **signals)
    at = np.searchsorted(rows[:, 0], rows[0, 0] + read.times + 1e-9, side="right") - 1
    return {"value": dataclasses.replace(read, inputs={"x_roll": rows[at, 1]}), "mean": read}


def estimate(flight: Flight, shift: bool) -> tuple[float, float]:
    """Return the error of If [%] and the shift [ms]."""
    free = {"Ixx": Free(0.03), "If": Free(2.5e-4)}
    params = Helicopter(**KNOWN, **TRUTH)
    nuisance = Nuisance(time_shift=shift)
    found = fit(Problem(models.roll_on_stand, params, [flight], free, nuisance=nuisance))
    late = found.nuisance["time_shift"].value if shift else 0.0
    return 100 * (found.estimates["If"].value / TRUTH["If"] - 1), 1e3 * late


def main(runs: int) -> None:
    """Print the table."""
    print(f"{runs} runs\n{'steps':12}{'rate':>6}  {'stick':12}{'If %':>8}{'+-':>7}{'shift ms':>10}")
    with tempfile.TemporaryDirectory() as name:
        for with_stamps in (True, False):
            for rate in (50.0, 100.0):
                results: dict[str, list[tuple[float, float]]] = {}
                for seed in range(runs):
                    rows = np.column_stack(record(np.random.default_rng(seed), with_stamps))
                    both = flights(rows, rate, Path(name))
                    for how, flight in both.items():
                        results.setdefault(how, []).append(estimate(flight, False))
                    results.setdefault("mean, shift", []).append(estimate(both["mean"], True))
                for how, pairs in results.items():
                    error, late = np.array(pairs).T
                    chance = error.std(ddof=1) / math.sqrt(runs)
                    where = "with stamps" if with_stamps else "any time"
                    print(
                        f"{where:12}{rate:6g}  {how:12}{error.mean():8.1f}{chance:7.1f}"
                        f"{late.mean():10.1f}",
                        flush=True,
                    )


if __name__ == "__main__":
    from script import Size, asked

    main(asked(__doc__, "ten minutes", Size("runs", 20, 2, "logs of each kind")).runs)
