"""Do the 95 % intervals cover? Many white-noise runs of the bench machine, fitted one by one.

    .venv/bin/python experiments/coverage.py [RUNS]

The records come from scipy and the closed form of eq. 23, not from our own simulation.
"""

import sys
from typing import Any

import jax
import numpy as np
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, load_vehicle, models
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.simulation.inputs import random_steps

jax.config.update("jax_enable_x64", True)
N, DT, NOISE = 4000, 0.02, 2e-3


def main(runs: int) -> None:
    vehicle = load_vehicle("configs/vehicles/bench-30.yaml")
    num, den = roll_transfer_function(vehicle, stand=True)
    discrete: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
    b, a = discrete[:2]
    truth = {"Ixx": float(vehicle.Ixx), "If": float(vehicle.If)}
    inside = dict.fromkeys(truth, 0)
    scores: dict[str, list[float]] = {name: [] for name in truth}
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        u = 3e-6 * random_steps(N, DT, rng, (0.2, 1.5))
        y = scipy.signal.lfilter(np.ravel(b), a, u) + NOISE * rng.standard_normal(N)
        flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
        free = {"Ixx": Free(0.05), "If": Free(5e-4)}
        found = fit(Problem(models.roll_on_stand, vehicle, [flight], free))
        assert found.status == "converged", (seed, found.status)
        for name, value in truth.items():
            e = found.estimates[name]
            assert e.sd is not None
            assert e.lower95 is not None
            assert e.upper95 is not None
            inside[name] += e.lower95 < value < e.upper95
            scores[name].append((e.value - value) / e.sd)
    print(f"{runs} runs of {N} samples, noise {NOISE} rad")
    for name, values in scores.items():
        print(
            f"{name}: 95 % intervals cover {100 * inside[name] / runs:.1f} %, "
            f"mean error {np.mean(values):+.2f} sd, spread {np.std(values):.2f} sd, "
            f"largest {np.max(np.abs(values)):.1f} sd"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
