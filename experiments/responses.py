"""Bias and coverage of measured responses: in closed loop, and with three sticks.

    .venv/bin/python experiments/responses.py [RUNS]

RUNS (40) of each case. The first is the R-50 in closed loop in double gusts, with four records of
90 s and windows of 20 s. Attitudes and rates to their sticks are computed directly, and with the
logged steps as instruments. The second has three inputs with a cross-feed of 0.3 and three outputs,
over 300 s, conditioned and one at a time. Inside: bins with real and imaginary part within 1.96 of
the stated error. Bias: root mean square over a band's bins of the mean error over all runs,
relative to the true response. The part from the runs' scatter is subtracted, and negative squares
count as zero.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
import r50_record
import scipy.signal
from r50_record import DT

from heli_jax import Flight, naming
from heli_jax.analysis.flight_responses import Settings, flight_responses
from heli_jax.analysis.responses import responses
from heli_jax.analysis.spectra import cross_spectra

jax.config.update("jax_enable_x64", True)
signal: Any = scipy.signal
SECONDS, RECORDS, GUSTS = 90.0, 4, 2.0
FEEDBACK = (0.12, 0.3)
"""Frequencies with strong feedback [Hz]."""
BAND = (0.12, 3.0)
SETTINGS = Settings(band=BAND, window=20.0, points=60)
PAIRS = (("lat", "p"), ("lat", "phi"), ("lon", "q"), ("lon", "theta"))
Z95 = 1.959963984540054
STEP, CROSS, NOISE, N = 0.02, 0.3, 0.3, 15000
"""System of three: sample time [s], cross-feed, noise over the response, samples."""


class Judged(NamedTuple):
    """Result of one response, over all runs."""

    inside: float
    square: float
    """Squared bias over the true response, which may be negative by chance."""
    scatter: float
    """Scatter of a run, over the true response."""

    @property
    def bias(self) -> float:
        """Bias over the true response."""
        return float(np.sqrt(max(self.square, 0.0)))


def judged(H: np.ndarray, sd: np.ndarray, true: np.ndarray, chosen: np.ndarray) -> Judged:
    """Judge runs (r, k) at the chosen frequencies."""
    H, sd, true = H[:, chosen], sd[:, chosen], true[chosen]
    error = (H - true) / np.abs(true)
    z = (H - true) / sd
    inside = np.mean(np.abs(np.stack([z.real, z.imag])) < Z95)
    variance = np.var(error, axis=0, ddof=1)
    square = np.mean(np.abs(np.mean(error, axis=0)) ** 2 - variance / len(H))
    return Judged(float(inside), float(square), float(np.sqrt(np.mean(variance))))


def flown(seed: int) -> Flight:
    """Return a record with the steps added to the regulator's sticks as instruments."""
    flight = r50_record.record(seed, SECONDS, GUSTS)
    rng, samples = np.random.default_rng(seed), flight.n_samples
    steps = [r50_record._random_steps(rng, samples) for _ in flight.inputs]
    instruments = dict(zip(flight.inputs, steps, strict=True))
    return Flight(dt=DT, inputs=flight.inputs, outputs=flight.outputs, instruments=instruments)


def true_r50(omega: np.ndarray, input: str, output: str) -> np.ndarray:
    """Return the exact response of the samples: x+ = A x + now u[k-d] + before u[k-d-1]."""
    step, model = r50_record._step(), r50_record.turbulent()
    states, j = naming.names(model.State), naming.names(model.Inputs).index(input)
    z = np.exp(1j * omega * DT)[:, None]
    late = step.whole if input == "ped" else 0
    drive = step.now[None, :13, j] * z**-late + step.before[None, :13, j] * z ** -(late + 1.0)
    A = step.A[:13, :13]
    x = np.linalg.solve(z[:, :, None] * np.eye(13) - A, drive[:, :, None])
    return x[:, states.index(output), 0]


def closed_loop(runs: int) -> None:
    found: dict[tuple[str, str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    omega = np.zeros(0)
    for run in range(runs):
        flights = [flown(1000 + RECORDS * run + i) for i in range(RECORDS)]
        bare = [Flight(dt=DT, inputs=f.inputs, outputs=f.outputs) for f in flights]
        for how, records in (("direct", bare), ("by instrument", flights)):
            by = flight_responses(records, SETTINGS)
            omega = by.omega
            for u, y in PAIRS:
                pair = by.outputs[y].pairs[u]
                found.setdefault((how, u, y), []).append((pair.H, pair.sd))
    hz = omega / (2.0 * np.pi)
    loop = (hz >= FEEDBACK[0]) & (hz <= FEEDBACK[1] * (1.0 + 1e-9))
    print(f"R-50 in closed loop, gusts x {GUSTS:g}, {runs} runs\n")
    print("| response | | inside | inside at 0.12-0.3 Hz | bias at 0.12-0.3 Hz | scatter |")
    print("|---|---|---|---|---|---|")
    for (how, u, y), each in found.items():
        H, sd = (np.array(v) for v in zip(*each, strict=True))
        seen = np.isfinite(H).all(axis=0)
        true = true_r50(omega, u, y)
        everywhere, low = judged(H, sd, true, seen), judged(H, sd, true, seen & loop)
        print(
            f"| {u} to {y} | {how} | {100 * everywhere.inside:.0f} % | {100 * low.inside:.0f} % | "
            f"{100 * low.bias:.1f} % | {100 * low.scatter:.1f} % |",
            flush=True,
        )


def three_sticks(runs: int) -> None:
    poles, gains = (
        np.array([2.0, 3.0, 5.0]),
        np.array([[4.0, 0.6, -0.4], [0.5, 6.0, 0.8], [-0.6, 0.4, 8.0]]),
    )
    omega = 2.0 * np.pi * np.geomspace(0.15, 3.0, 40)
    lags = [signal.cont2discrete(([1.0], [1.0, p]), STEP) for p in poles]
    true = np.stack([signal.freqz(b.ravel(), a, omega * STEP)[1] for b, a, _ in lags])
    true = np.moveaxis(true[:, None] * gains[:, :, None], 2, 0)
    both: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {"conditioned": [], "one at a time": []}
    slow = signal.butter(2, 3.0, fs=1.0 / STEP)
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        u = signal.lfilter(*slow, rng.standard_normal((3, N)))
        u = u + CROSS * np.roll(u, 1, axis=0)
        clean = np.stack(
            [signal.lfilter(b.ravel(), a, g @ u) for (b, a, _), g in zip(lags, gains, strict=True)]
        )
        noise = NOISE * clean.std(axis=1)[:, None] * rng.standard_normal((3, N))
        spectra = cross_spectra([np.concatenate([u, clean + noise])], STEP, omega, 20.0)
        joint = responses(spectra, [0, 1, 2], [3, 4, 5])
        alone = [responses(spectra, [j], [3, 4, 5]) for j in range(3)]
        both["conditioned"].append((joint.H, joint.sd))
        H, sd = (np.concatenate([getattr(a, n) for a in alone], axis=2) for n in ("H", "sd"))
        both["one at a time"].append((H, sd))
    print(f"\nThree inputs with a cross-feed of {CROSS:g}, {runs} runs\n")
    print("| | diagonal: inside | bias | off it: inside | bias |\n|---|---|---|---|---|")
    diagonal = np.eye(3, dtype=bool)
    for how, each in both.items():
        H, sd = (np.array(v) for v in zip(*each, strict=True))
        cells = []
        for where in (diagonal, ~diagonal):
            results = [
                judged(H[:, :, i, j], sd[:, :, i, j], true[:, i, j], np.ones(omega.size, bool))
                for i, j in zip(*np.nonzero(where), strict=True)
            ]
            cells += [
                f"{100 * np.mean([r.inside for r in results]):.0f} %",
                f"{100 * np.sqrt(max(np.mean([r.square for r in results]), 0.0)):.1f} %",
            ]
        print(f"| {how} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    from script import Size, asked

    options = asked(__doc__, "five minutes", Size("runs", 40, 4, "of each"))
    closed_loop(options.runs)
    three_sticks(options.runs)
