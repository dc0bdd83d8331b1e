"""Filter error on the bench with white noise and without a disturbance.

Its estimate of the absent disturbance must be correct, or missing. The records come from scipy and
the closed form of eq. 23, not from our own simulation.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.signal

from coverage_cases import BENCH, Case, Run, intervals
from heli_jax import Fit, Flight, Free, Problem, fit, load_vehicle, models
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.naming import asdict
from heli_jax.simulation.inputs import random_steps

N, DT, NOISE = 1000, 0.02, 2e-3
MODELS = {poles: with_disturbance(models.roll_on_stand, "roll", poles) for poles in (1, 2)}


def one_run(seed: int, poles: int = 1) -> Run:
    vehicle = load_vehicle(BENCH)
    num, den = roll_transfer_function(vehicle, stand=True)
    discrete: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
    b, a = discrete[:2]
    rng = np.random.default_rng(seed)
    u = 3e-6 * random_steps(N, DT, rng, (0.2, 1.5))
    y = scipy.signal.lfilter(np.ravel(b), a, u) + NOISE * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    free = {"Ixx": Free(0.05), "If": Free(5e-4)}
    start = {"sigma_w": jnp.asarray(0.0), "tau_w": jnp.asarray(1.0)}
    params = MODELS[poles].Params(**{**asdict(vehicle), **start})
    result = fit(Problem(MODELS[poles], params, [flight], free, method="filter-error"))
    run = intervals(result, {n: float(getattr(vehicle, n)) for n in free})
    run.flags.update(flags(result))
    return run


def flags(result: Fit) -> dict[str, bool]:
    """Return wrong statements about the absent disturbance."""
    sigma, tau = result.nuisance["sigma_w"], result.nuisance["tau_w"]
    absent = sigma.value == 0.0 and sigma.sd is None and tau.sd is None
    noted = any(f.code == "noise.no-disturbance" for f in result.findings)
    relative = [e.sd / e.value for e in (sigma, tau) if e.sd is not None and e.value > 0]
    return {
        "absurd sigma_w": not absent and not 1e-6 < sigma.value < 1e6,
        "absurd tau_w": not absent and not 0.99 * DT / 100 < tau.value < 1010 * N * DT,
        "absurdly sure": any(r < 1e-4 for r in relative),
        "absent but not said": absent != noted,
        "a disturbance is seen (5 % by the test's own level)": not absent,
        "not converged": result.status != "converged",
    }


def cases() -> list[Case]:
    return [
        Case("filter error, no disturbance, one pole", one_run, 500),
        Case("filter error, no disturbance, two poles", lambda seed: one_run(seed, 2), 200),
    ]
