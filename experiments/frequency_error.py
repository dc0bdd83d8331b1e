"""Frequency error on the disturbed bench: errors, and coverage of the intervals.

    .venv/bin/python experiments/frequency_error.py [RUNS] [METHOD]

Records of 120 s are made with SciPy alone, with gusts as large as the stick's response and without.
Ixx, If and kappa start off by a factor of 1.3. METHOD (frequency-error) may be output-error as
well.
"""

from pathlib import Path

import jax
import numpy as np
from coverage_cases.disturbed import response

from heli_jax import Flight, Free, Problem, fit, load_vehicle, models

jax.config.update("jax_enable_x64", True)
DT, SAMPLES, NOISE, TAU = 0.02, 6000, 2e-3, 1.0
NAMES = ("Ixx", "If", "kappa")
VEHICLE = load_vehicle(
    Path(__file__).parents[1] / "configs" / "vehicles" / "bench-30.yaml",
    models.roll_on_stand.Params,
)


def steps(rng: np.random.Generator) -> np.ndarray:
    """Return random steps of 0.2 to 1.5 s, at most 3 um."""
    lengths = (rng.uniform(0.2, 1.5, SAMPLES) / DT).astype(int) + 1
    return 3e-6 * np.repeat(rng.uniform(-1.0, 1.0, SAMPLES), lengths)[:SAMPLES]


def problem(seed: int, sigma: float, method: str) -> Problem:
    """Return the problem of a record in gusts of sigma [rad/s^2], from 1.3 times the truth."""
    rng = np.random.default_rng(seed)
    u = steps(rng)
    roll = response(VEHICLE, u, DT, sigma, TAU, rng)[:, 0]
    flight = Flight(
        dt=DT,
        inputs={"x_roll": u},
        outputs={"roll": roll + NOISE * rng.standard_normal(SAMPLES)},
    )
    free = {n: Free(1.3 * float(getattr(VEHICLE, n))) for n in NAMES}
    return Problem(models.roll_on_stand, VEHICLE, [flight], free, method=method)


def one_run(seed: int, sigma: float, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Return relative errors, and errors in units of the stated sd."""
    found = fit(problem(seed, sigma, method))
    truth = np.array([float(getattr(VEHICLE, n)) for n in NAMES])
    value = np.array([found.estimates[n].value for n in NAMES])
    sd = np.array([found.estimates[n].sd or np.nan for n in NAMES])
    return (value - truth) / truth, (value - truth) / sd


def main(runs: int, method: str) -> None:
    print("| gusts [rad/s^2] | " + " | ".join(f"{n}: RMSE, stated, covered" for n in NAMES) + " |")
    print("|---|" + "---|" * len(NAMES))
    for sigma in (1.04, 0.0):
        each = [one_run(seed, sigma, method) for seed in range(runs)]
        error, z = (np.array(v) for v in zip(*each, strict=True))
        rmse = 100.0 * np.sqrt(np.mean(error**2, axis=0))
        stated = 100.0 * np.nanmean(np.abs(error / z), axis=0)
        covered = 100.0 * np.mean(np.abs(z) < 1.959963984540054, axis=0)
        cells = [
            f"{a:.3g} %, {b:.3g} %, {c:.0f} %"
            for a, b, c in zip(rmse, stated, covered, strict=True)
        ]
        print(f"| {sigma:g} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "three minutes",
        Size("runs", 60, 3, "records with gusts, and without"),
        Size("method", "frequency-error", "frequency-error", "of the fit"),
    )
    main(options.runs, options.method)
