"""Two runs, one with a known inertia, determine Ixx, If and a: how large, how long, which input?

    .venv/bin/python experiments/added_inertia.py [SEEDS | --quick]

The roll response of one run shows only a/Ixx and a/If (Kim and Tilbury, 1997). A second run with a
known inertia added to the fuselage shows Ixx, so it determines all three. The bench is that of
configs/bench-gusts.yaml: 3 um of stick, 2 mrad of noise, gusts of 1.04 rad/s^2. A table gives the
expected sds of Ixx, If and a, and the duration of each run after which all are below
5 %. Then two runs are simulated with other gusts for each of SEEDS (200) seeds, and fitted: the
table compares the scatter with the expected standard deviations, and counts the intervals that
contain the truth.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import script

from heli_jax import Flight, Free, Nuisance, Problem, fit, load_vehicle, models, naming, simulate
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.flight_design import Design, InputLimit, Limits, Rated, design

jax.config.update("jax_enable_x64", True)
MODEL = with_disturbance(models.roll_on_stand, "roll")
DT, NOISE, STICK = 0.02, 2e-3, 3e-6
FREE = ("Ixx", "If", "a")
INERTIAS = (0.004, 0.012, 0.024)
"""Added inertias [kg m^2]; Ixx is 0.024."""
SECONDS, LOADED = 120.0, 0.012
"""Duration of each run [s] and added inertia of the fitted records."""


def truth() -> Any:
    vehicle = load_vehicle(Path(__file__).parents[1] / "configs" / "vehicles" / "bench-30.yaml")
    gusts = {"sigma_w": jnp.asarray(1.04), "tau_w": jnp.asarray(1.0)}
    return MODEL.Params(**naming.asdict(vehicle), **gusts)


def problem(seconds: float, inertia: float) -> Problem:
    """Return the problem of two runs, with the outputs of a doublet in calm air."""
    n = round(seconds / DT)
    u = STICK * np.sign(np.sin(2.0 * np.pi * np.arange(n) * DT))
    flights = []
    for added in (0.0, inertia):
        params = naming.replace(truth(), Ixx_added=jnp.asarray(added))
        run = simulate(MODEL, params, MODEL.Inputs(x_roll=jnp.asarray(u)), dt=DT)
        outputs = {"roll": np.asarray(run.outputs.roll)}
        known = {"Ixx_added": added}
        flights.append(Flight(DT, {"x_roll": u}, outputs, sd={"roll": NOISE}, known=known))
    free = {n: Free(float(getattr(truth(), n))) for n in FREE}
    return Problem(MODEL, truth(), flights, free, Nuisance(bias=False), method="filter-error")


def rated(seconds: float, inertia: float) -> Design:
    """Return the library of inputs, rated by the determinant of the covariance."""
    limits = Limits({"x_roll": InputLimit(STICK)})
    return design(problem(seconds, inertia), limits, max_steps=0)


def expected(seconds: float) -> None:
    """Print the expected standard deviations by inertia and input."""
    print(f"Expected sd of {', '.join(FREE)} with two runs of {seconds:g} s, and seconds for 5 %:")
    for inertia in INERTIAS:
        found = rated(seconds, inertia)
        chosen = [r for r in found.library if r.words in ("3-2-1-1 steps of 0.1 s",)]
        steps = [r for r in found.library if r.words.startswith("random")]
        for one in (found.library[0], *chosen, *steps):
            sds = ", ".join(f"{100 * one.sd[n]:.2f}" for n in FREE)
            needed = found.needed(one, dict.fromkeys(FREE, 0.05)) / 2.0
            print(f"  {inertia:.3f} kg m^2, {one.words:28s} {sds} %, {needed:.0f} s a run")


def fitted(of: Problem, input: Rated, seeds: int) -> None:
    """Print scatter, expected standard deviation and coverage of fits in gusts."""
    params, model = truth(), of.model
    initial_sd = MODEL.initial_sd
    assert initial_sd is not None

    @jax.jit
    def fly(u: Any, added: Any, key: Any) -> Any:
        here = naming.replace(params, Ixx_added=added)
        sds, first = initial_sd(here), MODEL.initial_state(here)
        draws = jax.random.normal(jax.random.fold_in(key, 2), (len(sds),))
        first = naming.replace(
            first, **{n: s * d for (n, s), d in zip(sds.items(), draws, strict=True)}
        )
        run = simulate(model, here, model.Inputs(x_roll=u), dt=DT, initial_state=first, key=key)
        return run.outputs.roll + NOISE * jax.random.normal(jax.random.fold_in(key, 1), u.shape)

    logs, inside, both = [], [], 0
    for seed in range(seeds):
        flights = []
        for k, (flight, own) in enumerate(zip(of.training, input.inputs, strict=True)):
            u = own["x_roll"]
            y = fly(jnp.asarray(u), flight.known["Ixx_added"], jax.random.key(2 * seed + k))
            flights.append(
                dataclasses.replace(flight, inputs={"x_roll": u}, outputs={"roll": np.asarray(y)})
            )
        result = fit(dataclasses.replace(of, flights=flights))
        both += result.status == "converged"
        values = [(result.estimates[n], float(getattr(params, n))) for n in FREE]
        logs.append([np.log(e.value / true) for e, true in values])
        inside.append(
            [(e.lower95 or np.inf) <= true <= (e.upper95 or -np.inf) for e, true in values]
        )
    scatter, covered = np.std(logs, axis=0, ddof=1), np.mean(inside, axis=0)
    print(
        f"{seeds} fits of {SECONDS:g} s runs, +{LOADED:g} kg m^2, {input.words}: {both} converged"
    )
    for n, s, c in zip(FREE, scatter, covered, strict=True):
        print(
            f"  {n:4s} scatter {100 * s:.2f} %, expected {100 * input.sd[n]:.2f} %, "
            f"coverage {100 * c:.1f} %"
        )


def main() -> None:
    size = script.Size("seeds", 200, 8, "pairs of runs")
    seeds = script.asked(__doc__, "five minutes", size).seeds
    expected(SECONDS)
    found = rated(SECONDS, LOADED)
    of = problem(SECONDS, LOADED)
    fitted(of, next(r for r in found.library if r.words == "3-2-1-1 steps of 0.1 s"), seeds)


if __name__ == "__main__":
    main()
