"""Filter error with an autopilot's attitude and the gyro from which it was integrated.

    .venv/bin/python experiments/integrated_angle.py [RUNS]

A flybarless roll in gusts is simulated in steps of 1 ms; a pilot holds it level, slowly. The gyro
is read at 1 kHz with white noise and logged at 100 Hz. The angle is logged twice: from a separate
sensor with white noise, and from an autopilot. The autopilot integrates the gyro and follows an
accelerometer within five seconds. The table has a row for each set of signals: the number of 95 %
intervals with the truth, the mean error [stated sd], and the estimates' mean and scatter.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from script import Size, asked

from heli_jax import Flight, Free, Problem, fit, linear_model
from heli_jax.dynamics.disturbance import with_disturbance

jax.config.update("jax_enable_x64", True)

TRUTH = {"Lb": 90.0, "tau_f": 0.06, "Blat": 0.2}
STARTS = {"Lb": 166.0, "tau_f": 0.046, "Blat": 0.14}
GUST, GUST_TIME = 1.5, 0.3
"""Standard deviation [rad/s^2] and correlation time [s]."""
STEP, EVERY, DURATION = 1e-3, 10, 60.0
GYRO, SENSOR, ACCELEROMETER, LEANS = 0.03, 0.004, 0.05, 0.2
"""Noises [rad/s, rad, rad], and the rate at which the estimator follows the accelerometer [1/s]."""


def logged(seed: int) -> dict[str, np.ndarray]:
    """Return one flight at 100 Hz: stick, gyro, angle of a sensor, angle of an estimator."""
    rng, n = np.random.default_rng(seed), int(DURATION / STEP)
    wanted, k = np.zeros(n), 0
    while k < n:
        length = int(rng.uniform(0.2, 0.8) / STEP)
        wanted[k : k + length] = rng.choice([-0.1, 0.0, 0.1, 0.05, -0.05])
        k += length
    kept = np.exp(-STEP / GUST_TIME)
    pushes = GUST * np.sqrt(1.0 - kept**2) * rng.standard_normal(n)
    phi = p = b = gust = lat = 0.0
    rows = np.zeros((n, 3))
    for i in range(n):
        if i % EVERY == 0:
            lat = wanted[i] - 0.15 * phi
        rows[i] = lat, p, phi
        slope = TRUTH["Blat"] * lat - b
        b += STEP * (slope / TRUTH["tau_f"] - p)
        p, phi = p + STEP * (TRUTH["Lb"] * b + gust), phi + STEP * p
        gust = kept * gust + pushes[i]
    gyro = rows[:, 1] + GYRO * rng.standard_normal(n)
    leaning = rows[:, 2] + ACCELEROMETER * rng.standard_normal(n)
    estimated, angle = np.zeros(n), 0.0
    for i in range(n):
        estimated[i] = angle
        angle += STEP * (gyro[i] + LEANS * (leaning[i] - angle))
    sensed = rows[:, 2] + SENSOR * rng.standard_normal(n)
    names = ("lat", "p", "phi, sensor", "phi, estimator")
    return dict(
        zip(
            names,
            (rows[::EVERY, 0], gyro[::EVERY], sensed[::EVERY], estimated[::EVERY]),
            strict=True,
        )
    )


def fitted(record: dict[str, np.ndarray], angle: str | None) -> Any:
    """Fit by filter error with a gust on roll; the angle by its name in the record, or none."""
    roll = linear_model("roll-flybarless")
    model = with_disturbance(roll.model, "roll")
    gust = {"sigma_w": jnp.asarray(1.0), "tau_w": jnp.asarray(0.2)}
    vehicle = model.Params(**roll.vehicle().params._asdict(), **gust)
    outputs = {"p": record["p"]} | ({} if angle is None else {"phi": record[angle]})
    flight = Flight(dt=STEP * EVERY, inputs={"lat": record["lat"]}, outputs=outputs)
    free = {name: Free(start) for name, start in STARTS.items()}
    return fit(Problem(model, vehicle, [flight], free, method="filter-error"))


def main() -> None:
    size = Size("runs", 20, 2, "flights")
    runs = asked(__doc__, "six minutes", size).runs
    print("| outputs | parameter | truth | mean ± scatter | error / sd | 95 % hold |")
    print("|---|---|---|---|---|---|")
    records = [logged(seed) for seed in range(runs)]
    for angle in (None, "phi, sensor", "phi, estimator"):
        fits = [fitted(record, angle) for record in records]
        what = "p" if angle is None else f"p and {angle}"
        for name, truth in TRUTH.items():
            values = np.array([f.estimates[name].value for f in fits])
            sd = np.array([f.estimates[name].sd or np.nan for f in fits])
            low = np.array([f.estimates[name].lower95 or np.nan for f in fits])
            high = np.array([f.estimates[name].upper95 or np.nan for f in fits])
            held = int(np.sum((low <= truth) & (truth <= high)))
            print(
                f"| {what} | {name} | {truth:g} | {values.mean():.3g} ± {values.std():.2g} "
                f"| {np.nanmean((values - truth) / sd):+.2f} | {held} of {runs} |"
            )


if __name__ == "__main__":
    main()
