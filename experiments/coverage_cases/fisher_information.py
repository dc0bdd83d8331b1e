"""Filter error on a measured roll rate: J'J as Fisher information, with given and free noise.

The records come from the paper's equations with SciPy, not from our own simulation.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np

from coverage_cases import BENCH, Case, Run, intervals
from coverage_cases.disturbed import response
from heli_jax import Flight, Free, Problem, fit, load_vehicle, models
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.naming import asdict
from heli_jax.simulation.inputs import random_steps

N, DT, NOISE, SIGMA, TAU = 4000, 0.02, 1e-3, 1.04, 1.0


def one_run(fixed: tuple[str, ...], seed: int) -> Run:
    vehicle = load_vehicle(BENCH)
    rng = np.random.default_rng(seed)
    u = 3e-6 * random_steps(N, DT, rng, (0.2, 1.5))
    y = response(vehicle, u, DT, SIGMA, TAU, rng)[:, 1] + NOISE * rng.standard_normal(N)
    model = with_disturbance(models.roll_on_stand, "roll")
    noise = {"sigma_w": jnp.asarray(0.5), "tau_w": jnp.asarray(TAU)}
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll_rate": y}, sd={"roll_rate": NOISE})
    free = {"Ixx": Free(0.03), "If": Free(2.5e-4)}
    params = model.Params(**asdict(vehicle), **noise)
    result = fit(Problem(model, params, [flight], free, method="filter-error", fixed_noise=fixed))
    truth = {n: float(getattr(vehicle, n)) for n in free}
    truth |= {n: v for n, v in (("sigma_w", SIGMA), ("tau_w", TAU)) if n not in fixed}
    return intervals(result, truth)


def cases() -> list[Case]:
    return [
        Case("filter error, sigma_y and tau_w given", partial(one_run, ("sigma_y", "tau_w"))),
        Case("filter error, noise free", partial(one_run, ())),
    ]
