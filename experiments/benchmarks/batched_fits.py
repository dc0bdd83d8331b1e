"""A bootstrap as one fused program compared with XLA:
`python experiments/benchmarks/batched_fits.py`.

Records of the bench's roll model, 60 s at 50 Hz, are fitted again from the optimum: three
parameters, the initial state and a bias, with exact steps and with RK4. Both ways run in turn in
this process, after one run of each that compiles. Times are per record, on all cores that the
process may use. The estimates must agree.
"""

import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import scipy.signal

from heli_jax import Fit, Flight, Free, Prior, Problem, fit, load_vehicle, models
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.identification.estimation import many_runs
from heli_jax.identification.uncertainty.bootstrap import Bootstrap, bootstrap
from heli_jax.numerics.cores import cores

jax.config.update("jax_enable_x64", True)
VEHICLE = load_vehicle(Path(__file__).parents[2] / "configs" / "vehicles" / "bench-30.yaml")
N, DT, FUSED, XLA = 3000, 0.02, 1000, 64
TURNS = 3
"""Number of runs; the best counts."""


def fitted(**how: Any) -> Fit:
    """Fit the record from which all others are simulated."""
    rng = np.random.default_rng(0)
    u = 3e-6 * np.repeat(rng.uniform(-1, 1, N // 25), 25)
    num, den = roll_transfer_function(VEHICLE, stand=True)
    discrete: Any = scipy.signal.cont2discrete((np.array(num), np.array(den)), DT)
    b, a = discrete[:2]
    y = scipy.signal.lfilter(np.ravel(b), a, u) + 2e-3 * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    free = {"Ixx": Free(0.05), "If": Free(5e-4), "a": Free(5.0, prior=Prior(5.5, 0.5))}
    return fit(Problem(models.roll_on_stand, VEHICLE, [flight], free, **how))


def timed(fit: Fit, runs: int, least: int) -> tuple[float, Bootstrap]:
    """Return seconds per record, and the result; with `least` runs or more the fused program is
    used.
    """
    many_runs._MANY = least
    begin = time.perf_counter()
    found = bootstrap(fit, runs)
    return (time.perf_counter() - begin) / runs, found


def main() -> None:
    """Print the table."""
    print(f"{cores()} cores; a record of {N} samples, 8 unknowns, in ms")
    solvers: dict[str, dict[str, Any]] = {"exact": {}, "rk4": {"solver": "rk4"}}
    for label, how in solvers.items():
        one = fitted(**how)
        ways = {"fused": (FUSED, 0), "xla": (XLA, FUSED + 1)}
        best = dict.fromkeys(ways, np.inf)
        values = {}
        for turn in range(TURNS + 1):
            for way, (runs, least) in ways.items():
                took, found = timed(one, runs, least)
                if turn:
                    best[way] = min(best[way], took)
                values[way] = found.values["Ixx"]
        own, other = (timed(one, XLA, least)[1].values["Ixx"] for _, least in ways.values())
        assert np.max(np.abs(own - other)) < 1e-3 * np.std(other)
        ratio = best["xla"] / best["fused"]
        print(
            f"{label}: fused {1e3 * best['fused']:.2f}, xla {1e3 * best['xla']:.1f}, "
            f"ratio {ratio:.0f}"
        )


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from script import Size, asked

    TURNS = asked(__doc__, "some minutes", Size("turns", 3, 1, "how often each is timed")).turns
    main()
