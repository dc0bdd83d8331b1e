"""Separation of the lift slope a from the inertias through the thrust, which carries a known mass.

    .venv/bin/python experiments/heave_separates_a.py [CASES | --quick] [--out FOLDER]

There are six two-second records of the X-Cell 60 about hover, with all sticks moving. Position,
attitude and rotor speed are measured to 2 mm, 2 mrad and 0.5 rad/s. The roll angle alone determines
none of the parameters, since it does not show the rotor speed, the climb and the other initial
states. Position shows the thrust, which depends on a and the mass, and a balance gives the mass.
Moving the throttle by 3 % also separates the rotor's inertia from the motor's gain; with 0.2 % only
their product is known. In rolling gusts, the extended Kalman filter estimates five parameters from
one record. FOLDER (runs/heave) gets results.json and page.md.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import Fit, Flight, Free, Nuisance, Problem, fit, load_vehicle, models, simulate, trim
from heli_jax.analysis.trim import Trim
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.naming import asdict, replace

jax.config.update("jax_enable_x64", True)
N, DT = 100, 0.02
NOISE = {
    "x": 2e-3, "y": 2e-3, "z": 2e-3, "roll": 2e-3, "pitch": 2e-3, "yaw": 2e-3, "rotor_speed": 0.5,
}  # fmt: skip
FREE = ("a", "Ixx", "Iyy", "Izz", "If", "Ir", "K_theta0", "K_throttle", "K_theta0T")
STICKS = {"x_roll": (1e-3, 10), "x_pitch": (1e-3, 10), "x_yaw": (0.2, 15)}
"""Size of the steps, and samples between two of them."""
MODEL = models.helicopter("consistent")
DISTURBED = with_disturbance(MODEL, "roll")
GUSTS = {"sigma_w": 0.5, "tau_w": 0.5}
"""Rolling gusts [rad/s^2, s]."""
IN_GUSTS = ("a", "Ixx", "If", "Ir", "K_theta0")


def vehicle() -> Any:
    return load_vehicle(Path(__file__).parents[1] / "configs" / "vehicles" / "x-cell-60.yaml")


def in_gusts() -> Any:
    """Return the vehicle's constants with those of the gusts."""
    gusts = {n: jnp.asarray(v) for n, v in GUSTS.items()}
    return DISTURBED.Params(**asdict(vehicle()), **gusts)


def sticks(
    hover: Trim, rng: np.random.Generator, throttle: float, moved: tuple[str, ...] = tuple(STICKS)
) -> dict[str, np.ndarray]:
    """Return steps about hover, with the throttle by up to `throttle` in both directions."""
    inputs = {}
    for name, about in hover.inputs._asdict().items():
        size, hold = (throttle, 15) if name == "x_throttle" else STICKS[name]
        size = size if name == "x_throttle" or name in moved else 0.0
        inputs[name] = (
            float(about) + size * np.repeat(rng.uniform(-1.0, 1.0, N // hold + 1), hold)[:N]
        )
    return inputs


def records(
    throttle: float,
    measured: tuple[str, ...] = tuple(NOISE),
    moved: tuple[str, ...] = tuple(STICKS),
    count: int = 6,
) -> list[Flight]:
    """Return records about hover, with the throttle by up to `throttle` in both directions."""
    params = vehicle()
    hover = trim(MODEL, params)
    flights = []

    @jax.jit
    def flown(inputs: Any) -> Any:
        return simulate(MODEL, params, inputs, dt=DT, initial_state=hover.state).outputs

    for seed in range(count):
        rng = np.random.default_rng(seed)
        inputs = sticks(hover, rng, throttle, moved)
        run = flown(MODEL.Inputs(**{n: jnp.asarray(u) for n, u in inputs.items()}))
        outputs = {
            n: np.asarray(getattr(run, n)) + sd * rng.standard_normal(N) for n, sd in NOISE.items()
        }
        outputs = {n: outputs[n] for n in measured}
        flights.append(
            Flight(dt=DT, inputs=inputs, outputs=outputs, sd={n: NOISE[n] for n in measured})
        )
    return flights


def gusty() -> Flight:
    """Return a record in gusts, with all sticks and the throttle moving."""
    hover = trim(MODEL, vehicle())
    inputs = sticks(hover, np.random.default_rng(0), 0.03)
    start = DISTURBED.State(**asdict(hover.state), w1_roll=jnp.asarray(0.3))
    held = DISTURBED.Inputs(**{n: jnp.asarray(u) for n, u in inputs.items()})
    key = jax.random.key(1)
    run = simulate(DISTURBED, in_gusts(), held, dt=DT, initial_state=start, key=key).outputs
    rng = np.random.default_rng(1)
    outputs = {
        n: np.asarray(getattr(run, n)) + sd * rng.standard_normal(N) for n, sd in NOISE.items()
    }
    return Flight(dt=DT, inputs=inputs, outputs=outputs, sd=NOISE)


def identify(flights: list[Flight], names: tuple[str, ...] = FREE) -> Fit:
    """Fit from values that are off by 15 % on average."""
    params = vehicle()
    rng = np.random.default_rng(0)
    free = {
        n: Free(float(getattr(params, n)) * float(np.exp(0.15 * rng.standard_normal())))
        for n in names
    }
    start = replace(params, **{n: jnp.asarray(f.start) for n, f in free.items()})
    nuisance = Nuisance(bias=False)
    return fit(Problem(MODEL, start, flights, free, nuisance, substeps=2), progress=print)


def identify_in_gusts() -> Fit:
    """Fit by filter error from values that are off by 10 %."""
    params = in_gusts()
    free = {n: Free(1.1 * float(getattr(params, n))) for n in IN_GUSTS}
    options = {"method": "filter-error", "substeps": 1}
    problem = Problem(DISTURBED, params, [gusty()], free, Nuisance(bias=False), **options)
    return fit(problem, progress=print)


def table(result: Fit) -> list[str]:
    params = in_gusts()
    rows = ["| parameter | estimate over truth | sd | error in sd |", "|---|---|---|---|"]
    of_gusts = {n: e for n, e in result.nuisance.items() if n in GUSTS}
    for name, e in {**result.estimates, **of_gusts}.items():
        truth = float(getattr(params, name))
        if e.sd is None:
            rows.append(f"| {name} | not determined | | |")
            continue
        error = (e.value - truth) / e.sd
        rows.append(
            f"| {name} | {e.value / truth:.4f} | {100 * e.sd / truth:.2f} % | {error:+.1f} |"
        )
    return rows


ROLL = ("a", "Ixx", "If", "Ir", "K_theta0", "K_throttle")
CASES: dict[str, Callable[[], Fit]] = {
    "roll alone": lambda: identify(records(0.0, ("roll",), ("x_roll",)), ROLL),
    "all measured, throttle moved by 0.2 %": lambda: identify(records(0.002)),
    "all measured, throttle moved by 3 %": lambda: identify(records(0.03)),
    "all measured, throttle moved by 3 %, one record in gusts": identify_in_gusts,
}


def main(folder: Path, cases: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    page, results = ["# What separates a from the inertias", ""], {}
    for title, identified in list(CASES.items())[:cases]:
        result = identified()
        page += [f"## {title}", "", *table(result), "", f"{result.status}: {result.verdict.text}"]
        page += [*result.notes, ""]
        results[title] = {
            "status": result.status,
            "condition": result.verdict.condition,
            "values": {n: e.value for n, e in result.estimates.items()},
            "sd": {n: e.sd for n, e in result.estimates.items()},
            "pairs": [list(p) for p in result.verdict.pairs],
        }
    (folder / "page.md").write_text("\n".join(page))
    (folder / "results.json").write_text(json.dumps(results, indent=1))
    print("\n".join(page))


if __name__ == "__main__":
    from script import Size, asked

    cases = Size("cases", len(CASES), 1, "how many of them, the shortest first")
    options = asked(__doc__, "ten minutes", cases, out="runs/heave")
    main(options.out, options.cases)
