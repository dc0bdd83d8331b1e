"""Accuracy of the lag between two logs.

    .venv/bin/python experiments/alignment.py [RUNS]

The same random motion is logged on two clocks with jitter, with several rates, bands and noise
levels; RUNS (100) of each.
"""

import numpy as np

from heli_jax.flights.align import NotAligned, lag_between
from heli_jax.flights.resample import Timed

CASES = [
    # rates [Hz], fastest part of the motion [Hz], noise over the motion's sd
    ((100, 50), 2.0, (0.1, 0.1)),
    ((400, 100), 3.0, (0.3, 0.05)),
    ((50, 240), 1.5, (0.02, 0.3)),
    ((100, 100), 4.0, (0.05, 0.05)),
    ((100, 30), 2.0, (0.01, 0.01)),
    ((200, 100), 1.0, (0.5, 0.2)),
]


def one(seed: int, rates: tuple[int, int], fastest: float, noise: tuple[float, float]):
    """Return the estimated lag, and the true one [s]."""
    rng = np.random.default_rng(seed)
    w, phase = 2 * np.pi * rng.uniform(0.05, fastest, 100), rng.uniform(0, 2 * np.pi, 100)
    size = rng.standard_normal(100)
    true, signals = rng.uniform(-5.0, 5.0), []
    for (first, last), rate, n, late in zip(
        [(0, 40), (5, 35)], rates, noise, (0.0, true), strict=True
    ):
        t = np.arange(first * rate, last * rate) / rate
        t = t + rng.uniform(-0.1, 0.1, t.size) / rate
        x = np.sin(np.multiply.outer(t, w) + phase) @ size
        x = x + n * np.std(x) * rng.standard_normal(t.size)
        signals.append(Timed(t - late, x))
    return lag_between(*signals), true


def row(case, runs: int) -> str:
    rates, fastest, noise = case
    errors, refused = [], 0
    for seed in range(runs):
        try:
            found, true = one(seed, rates, fastest, noise)
        except NotAligned:
            refused += 1
            continue
        errors.append(found.lag - true)
    error = np.array(errors)
    return (
        f"| {rates[0]} and {rates[1]} Hz | {fastest:g} Hz | {noise[0]:g} and {noise[1]:g} "
        f"| {1e3 * error.std():.3f} ms | {error.mean() / error.std():+.2f} sd | {refused} |"
    )


def main(runs: int) -> None:
    print("| rates | motion up to | noise | sd | mean error | refused |")
    print("|---|---|---|---|---|---|")
    for case in CASES:
        print(row(case, runs), flush=True)


if __name__ == "__main__":
    from script import Size, asked

    main(asked(__doc__, "two minutes", Size("runs", 100, 3, "of each case")).runs)
