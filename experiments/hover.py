"""Hover in gusts: a controller for the mean vehicle, and one for the posterior.

Three seconds of flight of the X-Cell 60 with servos and noisy sensors are identified. A regulator
with a Kalman filter is optimal for the estimates alone. Its gains are then tuned by gradients for
vehicles of the posterior, with a distance of every loop from -1. Both fly other vehicles of the
posterior in gusts:

    python experiments/hover.py [FOLDER]

prints the share of stable vehicles, margins and deviations, and writes figures to FOLDER (default:
runs/hover).
"""

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads wait for each other in small matrices

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import heli_jax
from heli_jax import Flight, Free, Nuisance, Problem, naming
from heli_jax.analysis.trim import trim
from heli_jax.control.controller import begin, commands, with_controller
from heli_jax.control.posterior import SteadyFlights, draws, vehicles_of
from heli_jax.control.regulators import lqg, lqr
from heli_jax.control.tune import Scenario, Tuning, gusts, tune
from heli_jax.dynamics.helicopter import helicopter
from heli_jax.dynamics.onboard.servos import with_servos
from heli_jax.simulation.simulate import simulate, substeps_for

matplotlib.use("Agg")
import matplotlib.pyplot as plt

CONFIGS = Path(__file__).parent.parent / "configs"
DT = 0.02
SERVO = {"omega_servo": 2 * np.pi * 6.0, "zeta_servo": 0.7}
"""Servos of 6 Hz, known from a bench test."""
SD = {
    "roll": 0.02, "pitch": 0.02, "yaw": 0.02, "roll_rate": 0.1, "pitch_rate": 0.1,
    "yaw_rate": 0.1, "dz": 0.2, "rotor_speed": 4.0,
}  # fmt: skip
FREE = ("a", "Ixx", "Iyy", "Izz", "If", "K_theta0T")
MOST = {
    "x": 0.1, "y": 0.1, "z": 0.1, "psi": 0.1, "x_roll": 0.1, "x_pitch": 0.1, "x_yaw": 20.0,
    "x_collective": 10.0,
}  # fmt: skip
"""Sharp position hold, without regard for the sticks."""
SENSORS = {**SD, "x": 0.04, "y": 0.04, "z": 0.04}
NOISE = {
    "wind_x": 0.2, "wind_y": 0.2, "wind_z": 0.2, "dphi": 0.02, "dtheta": 0.02, "dpsi": 0.02,
}  # fmt: skip
"""Noise of the filter: sensors, and gusts and moments [SI times sqrt(s)]."""
GENTLE = {"phi": 0.2, "theta": 0.2, "psi": 0.3, "x_roll": 1e-3, "x_pitch": 1e-3, "x_yaw": 0.2}
"""Attitude hold of the flight that is identified."""


def model_of(*, wind):
    return with_servos(helicopter(wind=wind), on=("x_roll", "x_pitch", "x_collective"))


def identified(vehicle, seconds, seed):
    """Return the fit of a short flight, held by a pilot."""
    model, rng = model_of(wind=False), np.random.default_rng(seed)
    params = model.Params(**naming.asdict(vehicle), **SERVO)
    hover = trim(model, params)
    n = round(seconds / DT)

    def steps(size):
        return size * np.repeat(rng.uniform(-1.0, 1.0, n // 15 + 1), 15)[:n]

    moves = {"x_roll": 5e-4, "x_pitch": 5e-4, "x_yaw": 0.1, "x_collective": 0.03}
    inputs = {
        k: float(v) + steps(moves[k]) if k in moves else np.full(n, float(v))
        for k, v in naming.asdict(hover.inputs).items()
    }
    hold = lqr(model, params, hover, most=GENTLE, dt=DT)
    closed = with_controller(model, hold)
    p = closed.Params(**naming.asdict(params))
    state, given = begin(closed, p, hover, n)
    given = naming.replace(given, **{k: jnp.asarray(v) for k, v in inputs.items()})
    run = simulate(
        closed, p, given, dt=DT, initial_state=state, substeps=substeps_for(DT, closed.fastest)
    )
    for k, command in commands(closed, p, run).items():
        inputs[k] = inputs[k] + np.asarray(command)
    flight = Flight(
        DT,
        inputs,
        {
            k: np.asarray(getattr(run.outputs, k)) + sd * rng.standard_normal(n)
            for k, sd in SD.items()
        },
        sd=SD,
    )
    free = {k: Free(float(getattr(params, k)) * rng.uniform(0.8, 1.25)) for k in FREE}
    problem = Problem(model, params, [flight], free, Nuisance(bias=False), window=2.0)
    return params, heli_jax.fit(problem)


def main():
    jax.config.update("jax_enable_x64", True)
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/hover")
    folder.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    vehicle = heli_jax.load_vehicle(CONFIGS / "vehicles" / "x-cell-60.yaml")
    params, fit = identified(vehicle, seconds=3.0, seed=5)
    print(f"fit: {fit.status}")
    for name, e in fit.estimates.items():
        true = float(getattr(params, name))
        share = 100 * (e.sd or np.nan) / abs(e.value)
        print(f"  {name:10} {e.value:9.4g} +- {share:.1f} % (true {true:.4g})")

    model, rng, n = model_of(wind=True), np.random.default_rng(1), 400
    values = draws(fit, 232, seed=2)
    vehicles, flights, lost = vehicles_of(model, params, values)
    print(f"vehicles without hover: {lost} of 232")

    def tuning(a, b, law):
        some, steady = jax.tree.map(lambda v: v[a:b], (vehicles, flights))
        return Tuning(model, some, steady, law, scenario, MOST)

    def tuned(b, distance):
        some, steady = jax.tree.map(lambda v: v[:b], (vehicles, flights))
        return tune(model, some, steady, law, scenario, most=MOST, distance=distance, max_steps=400)

    first = SteadyFlights(*jax.tree.map(lambda v: v[0], (flights.state, flights.inputs)))
    mean = jax.tree.map(lambda v: v[0], vehicles)
    law = lqg(model, mean, first, most=MOST, sd=SENSORS, noise=NOISE, dt=DT, references=("x",))
    wind = {"wind_x": gusts(1.0, 1.0, n, DT, rng), "wind_y": gusts(1.0, 1.0, n, DT, rng),
            "wind_z": gusts(0.5, 0.5, n, DT, rng)}  # fmt: skip
    scenario = Scenario(wind, {"x": np.where(np.arange(n) > 100, 0.1, 0.0)}, n)
    robust = tuned(64, 0.3)
    print(f"tuning converged: {robust.converged}; cost {robust.cost}, distance {robust.distance}")
    tested, mean_alone = tuning(64, None, law), tuning(0, 1, law)
    fig, axes = plt.subplots(2, 2, figsize=(10, 6), sharex=True, sharey="row")
    for column, (words, made) in enumerate((("mean", law), ("posterior", robust.controller))):
        distance, stable = tested.judged(made)
        margins, flown = tested.margins(made), tested.flown(made)
        gain = min(float(np.nanquantile(m.gain[m.stable], 0.05)) for m in margins)
        phase = min(float(np.nanquantile(m.phase[m.stable], 0.05)) for m in margins)
        held = np.sqrt(np.mean(np.square(np.clip(flown.deviations["z"], -9.9, 9.9)), axis=1))
        print(
            f"tuned for the {words}: cost of the mean vehicle "
            f"{mean_alone.cost_of(made):.3f}, "
            f"stable {100 * stable:.1f} % of {len(held)}, least distance {distance:.2f}, "
            f"margins {gain:.1f} dB and {phase:.0f} deg in 95 %, "
            f"height rms {np.median(held):.3f} m"
        )
        t = DT * np.arange(n)
        for row, (name, unit) in enumerate((("x", "m"), ("theta", "rad"))):
            y = np.clip(np.nan_to_num(flown.deviations[name]), -2.0, 2.0)
            axes[row, column].plot(t, y.T, color="C0", lw=0.3, alpha=0.5)
            axes[row, column].set_ylabel(f"{name} [{unit}]")
        axes[0, column].set_title(f"tuned for the {words}: {100 * stable:.1f} % stable")
        axes[1, column].set_xlabel("time [s]")
    fig.tight_layout()
    fig.savefig(folder / "hover.png", dpi=120)
    print(f"{time.monotonic() - begun:.0f} s; figure: {folder / 'hover.png'}")


if __name__ == "__main__":
    main()
