"""All responses of a flight with five windows beside the same by loops over SciPy.

    .venv/bin/python experiments/benchmarks/responses.py [MINUTES]

4 inputs that move together, 9 outputs, 10 minutes at 100 Hz. SciPy's loop takes csd of every pair
of signals at every window's length, and solves for the responses at each of the same frequencies;
it makes no composite, coherences or errors. On one thread, the best of some runs each, in turn.
The target: 0.5 s warm and 1/20 of the loop.
"""

import os
import sys
import time
from collections.abc import Callable
from typing import Any

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import numpy as np
import scipy.signal

from heli_jax import Flight
from heli_jax.analysis.flight_responses import Settings, flight_responses

jax.config.update("jax_enable_x64", True)
RATE, INPUTS, OUTPUTS, WINDOW, RUNS = 100.0, 4, 9, 20.0, 5
LENGTHS = (0.25, 0.5, 1.0, 1.5, 2.0)


def flight(minutes: float) -> Flight:
    rng = np.random.default_rng(0)
    N = round(60.0 * minutes * RATE)
    u = rng.standard_normal((INPUTS, N))
    u[1:] += 0.4 * u[:-1]
    b, a = scipy.signal.butter(2, 5.0, fs=RATE)
    mixed = rng.standard_normal((OUTPUTS, INPUTS)) @ u
    y = scipy.signal.lfilter(b, a, mixed) + 0.1 * rng.standard_normal((OUTPUTS, N))
    inputs = {f"u{i}": v for i, v in enumerate(u)}
    return Flight(dt=1.0 / RATE, inputs=inputs, outputs={f"y{i}": v for i, v in enumerate(y)})


def by_scipy(record: Flight, omega: np.ndarray) -> np.ndarray:
    """H (windows, k, outputs, inputs)."""
    u, y = list(record.inputs.values()), list(record.outputs.values())
    found = []
    for length in LENGTHS:
        n = round(length * WINDOW * RATE)

        def csd(a: np.ndarray, b: np.ndarray, n: int = n) -> np.ndarray:
            hz, S = scipy.signal.csd(a, b, fs=RATE, nperseg=n, noverlap=n // 2, detrend="constant")
            w = 2.0 * np.pi * hz
            return np.interp(omega, w, S.real) + 1j * np.interp(omega, w, S.imag)

        Suu = np.array([[csd(a, b) for b in u] for a in u])
        Suy = np.array([[csd(a, b) for b in y] for a in u])
        solved = [np.linalg.solve(Suu[:, :, k], Suy[:, :, k]).T for k in range(omega.size)]
        found.append(np.stack(solved))
    return np.stack(found)


def seconds(do: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.perf_counter()
    done = do()
    return time.perf_counter() - begin, done


def main(minutes: float) -> None:
    record, settings = flight(minutes), Settings(window=WINDOW)
    cold, found = seconds(lambda: flight_responses([record], settings))
    ours, theirs, loop, omega = [], [], np.zeros(0), found.omega
    for _ in range(RUNS):
        took, found = seconds(lambda: flight_responses([record], settings))
        ours.append(took)
        took, loop = seconds(lambda: by_scipy(record, omega))
        theirs.append(took)
    # The middle window is the one that intervals are taken from.
    H = np.array([[p.H for p in o.pairs.values()] for o in found.outputs.values()])
    middle = np.moveaxis(loop[2], 0, -1)
    seen = np.isfinite(H)
    off = np.median(np.abs(H - middle)[seen] / np.abs(H)[seen])
    print(f"cold {cold:.2f} s, warm {min(ours):.3f} s; SciPy's loop {min(theirs):.2f} s")
    print(f"1/{min(theirs) / min(ours):.1f} of it; responses differ by {100 * off:.1f} % (median,")
    print("since SciPy has its own frequencies, between which the loop interpolates)")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
