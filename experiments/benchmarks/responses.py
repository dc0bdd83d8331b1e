"""Time of all responses of a flight, compared with loops over SciPy.

    .venv/bin/python experiments/benchmarks/responses.py [MINUTES]

4 inputs that move together, 9 outputs, 10 minutes at 100 Hz. SciPy's loop goes over outputs: csd of
every pair of the four inputs and the output (15), then a solution at each frequency. The lean loop
reuses the spectra of inputs for all outputs. Neither computes coherences or errors. On one thread,
the best of some runs each, in turn. The target: 0.2 s warm.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import numpy as np
import scipy.signal

from heli_jax import Flight
from heli_jax.analysis.flight_responses import Settings, flight_responses
from heli_jax.analysis.spectra import OVERLAP

jax.config.update("jax_enable_x64", True)
signal: Any = scipy.signal
RATE, INPUTS, OUTPUTS, WINDOW, RUNS = 100.0, 4, 9, 20.0, 5


def flight(minutes: float) -> Flight:
    rng = np.random.default_rng(0)
    N = round(60.0 * minutes * RATE)
    u = rng.standard_normal((INPUTS, N))
    u[1:] += 0.4 * u[:-1]
    b, a = signal.butter(2, 5.0, fs=RATE)
    mixed = rng.standard_normal((OUTPUTS, INPUTS)) @ u
    y = signal.lfilter(b, a, mixed) + 0.1 * rng.standard_normal((OUTPUTS, N))
    inputs = {f"u{i}": v for i, v in enumerate(u)}
    return Flight(dt=1.0 / RATE, inputs=inputs, outputs={f"y{i}": v for i, v in enumerate(y)})


def by_scipy(record: Flight, omega: np.ndarray, lean: bool) -> np.ndarray:
    """Return H (k, outputs, inputs)."""
    u, y = list(record.inputs.values()), list(record.outputs.values())
    n = round(WINDOW * RATE)

    def csd(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        both = round(OVERLAP * n)
        hz, S = signal.csd(a, b, fs=RATE, nperseg=n, noverlap=both, detrend="constant")
        w = 2.0 * np.pi * hz
        return np.interp(omega, w, S.real) + 1j * np.interp(omega, w, S.imag)

    of_inputs, each = np.zeros(0), []
    for output in y:
        if not lean or not each:
            of_inputs = spectra(u, csd)
        Suy = np.array([csd(a, output) for a in u])
        if not lean:
            csd(output, output)
        each.append(np.linalg.solve(np.moveaxis(of_inputs, 2, 0), Suy.T[:, :, None])[:, :, 0])
    return np.stack(each, axis=1)


def spectra(u: list[np.ndarray], csd: Callable[..., np.ndarray]) -> np.ndarray:
    """Return (m, m, k) of every pair of inputs, with each pair computed once."""
    m = len(u)
    half = {(i, j): csd(u[i], u[j]) for i in range(m) for j in range(i, m)}
    rows = [[half[i, j] if i <= j else half[j, i].conj() for j in range(m)] for i in range(m)]
    return np.array(rows)


def seconds(do: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.perf_counter()
    done = do()
    return time.perf_counter() - begin, done


def main(minutes: float) -> None:
    record, settings = flight(minutes), Settings(window=WINDOW)
    cold, found = seconds(lambda: flight_responses([record], settings))
    ours, theirs, lean, loop, omega = [], [], [], np.zeros(0), found.omega
    for _ in range(RUNS):
        took, found = seconds(lambda: flight_responses([record], settings))
        ours.append(took)
        took, loop = seconds(lambda: by_scipy(record, omega, lean=False))
        theirs.append(took)
        lean.append(seconds(lambda: by_scipy(record, omega, lean=True))[0])
    H = np.array([[p.H for p in o.pairs.values()] for o in found.outputs.values()])
    loop = np.moveaxis(loop, 0, -1)
    seen = np.isfinite(H)
    off = np.median(np.abs(H - loop)[seen] / np.abs(H)[seen])
    best = min(ours)
    print(f"cold {cold:.2f} s, warm {best:.3f} s")
    for name, loops in (("loop", theirs), ("lean loop", lean)):
        print(f"SciPy's {name} {min(loops):.2f} s: 1/{min(loops) / best:.1f} of it")
    print(f"responses differ by {100 * off:.1f} % (median; SciPy has its own frequencies, between")
    print("which the loop interpolates)")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from script import Size, asked

    minutes = Size("minutes", 10.0, 2.0, "of the record")
    main(asked(__doc__, "some minutes", minutes).minutes)
