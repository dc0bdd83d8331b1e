"""Effect of the noise-spectrum estimate on fits of responses, relative to the Cramér-Rao bound.

    .venv/bin/python experiments/response_weights.py [RUNS] [WINDOW] [FIRST]

The records are those of experiments/frequency_response.py with gusts and pilot steps.
`frequency-response` runs with a known spectrum, with its estimate, and with a mean over two lines
of the window at any number of averages. The known one is the mean over 150 records of gusts and
noise alone.
"""

from unittest import mock

import jax
import numpy as np
from frequency_error import DT, NAMES, SAMPLES, steps
from frequency_response import bound, one_fit, record

from heli_jax import Flight
from heli_jax.analysis.spectra import ResponseOptions, windowed
from heli_jax.identification.estimation import frequency_response, response_weights

jax.config.update("jax_enable_x64", True)
SIGMA, RECORDS = 1.04, 150
MODULES = (frequency_response, response_weights)


def density(window: float) -> np.ndarray:
    """Return the density (k, 1, 1) of gusts and noise in windows."""
    rng, power = np.random.default_rng(12345), np.zeros((1, 1))
    for _ in range(RECORDS):
        still = record(rng, np.zeros(SAMPLES), SIGMA)
        # Windows need a moving stick; here it has no effect.
        moved = Flight(dt=DT, inputs={"x_roll": np.arange(SAMPLES) % 7.0}, outputs=still.outputs)
        Y = windowed([moved], ResponseOptions(window=window)).Y
        power = power + np.mean(np.abs(Y) ** 2, axis=0)
    return (power / RECORDS)[:, :, None].astype(complex)


def main(runs: int, window: float, first: int) -> None:
    known = density(window)

    def given(w, at, E) -> np.ndarray:
        return known

    cases = {
        "known": [mock.patch.object(m, "noise_density", given) for m in MODULES],
        "estimated": [],
        "estimated over two lines": [mock.patch.object(response_weights, "_ENOUGH", np.inf)],
    }
    print("| spectrum | " + " | ".join(NAMES) + " |\n|---|" + "---|" * len(NAMES))
    for name, patches in cases.items():
        rows = []
        for seed in range(first, first + runs):
            rng = np.random.default_rng(seed)
            u = steps(rng)
            flight = record(rng, u, SIGMA)
            for patch in patches:
                patch.start()
            try:
                _, error, held = one_fit(flight, "frequency-response", window)
            finally:
                for patch in patches:
                    patch.stop()
            rows.append((error / bound(u, SIGMA), held))
        ratio, held = (np.array(v) for v in zip(*rows, strict=True))
        rmse, covered = np.sqrt(np.mean(ratio**2, axis=0)), np.nanmean(held, axis=0)
        cells = [f"{a:.2f}, {100 * c:.0f} %" for a, c in zip(rmse, covered, strict=True)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "four minutes",
        Size("runs", 40, 2, "records"),
        Size("window", 10.0, 10.0, "[s]"),
        Size("first", 0, 0, "seed of the first record"),
    )
    main(options.runs, options.window, options.first)
