"""Does a designed input give the accuracy that it promises?

The input of configs/bench-design.yaml and the best one of the library are flown in gusts, again and
again, and fitted. The scatter of the estimates is compared with the expected standard deviation:

    python experiments/input_design.py [RUNS]

prints both for the combinations that the data determine, with their ratio.
"""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import heli_jax
from heli_jax.config import load
from heli_jax.design_workflow import run_design
from heli_jax.identification.flight_design import Rated
from heli_jax.simulation.simulate import simulate

CONFIG = Path(__file__).parent.parent / "configs" / "bench-design.yaml"
PRODUCTS = ("a/Ixx", "a/If")


def scatter(problem: heli_jax.Problem, rated: Rated, runs: int) -> dict[str, np.ndarray]:
    """Return the estimated products (runs,) of simulated flights."""
    flight, model = problem.training[0], problem.model
    u = {n: rated.inputs[0].get(n, np.zeros(flight.n_samples)) for n in flight.inputs}
    params, initial_sd = problem.start_params(), model.initial_sd
    assert initial_sd is not None

    @jax.jit
    def fly(key: jax.Array) -> dict[str, jax.Array]:
        of_gusts, of_noise = jax.random.split(key)
        inputs = model.Inputs(**{n: jnp.asarray(v) for n, v in u.items()})
        first = model.initial_state(params)
        # The gusts are in their steady state at the first sample.
        sds = initial_sd(params)
        for k, (n, sd) in zip(jax.random.split(of_gusts, len(sds)), sds.items(), strict=True):
            first = first._replace(**{n: sd * jax.random.normal(k)})
        run = simulate(
            model, params, inputs, dt=flight.dt, initial_state=first, key=jax.random.fold_in(key, 1)
        )
        return {
            n: getattr(run.outputs, n)
            + flight.sd[n] * jax.random.normal(jax.random.fold_in(of_noise, i), (flight.n_samples,))
            for i, n in enumerate(flight.outputs)
        }

    found: dict[str, list[float]] = {p: [] for p in PRODUCTS}
    for seed in range(runs):
        y = {n: np.asarray(v) for n, v in fly(jax.random.key(seed)).items()}
        flown = dataclasses.replace(flight, inputs=u, outputs=y)
        fit = heli_jax.fit(dataclasses.replace(problem, flights=(flown,)))
        values = {n: e.value for n, e in fit.estimates.items()}
        for product in PRODUCTS:
            above, _, below = product.partition("/")
            found[product].append(values[above] / values[below])
    return {p: np.log(v) for p, v in found.items()}


def main(runs: int) -> None:
    jax.config.update("jax_enable_x64", True)
    designed = run_design(load(CONFIG))
    for rated in (designed.design.library[0], designed.design.optimum):
        estimates = scatter(designed.problem, rated, runs)
        for product, logs in estimates.items():
            expected = designed.design.sd_of(rated, product)
            found = float(np.std(logs, ddof=1))
            print(
                f"{rated.words:28s} {product:6s} expected {100 * expected:5.2f} %, scatter "
                f"{100 * found:5.2f} % of {runs} runs, ratio {found / expected:.2f}"
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
