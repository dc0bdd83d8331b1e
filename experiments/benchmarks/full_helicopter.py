"""Speed of the variant `full` against the same equations in C, as `helicopter.py` has the other.

Flapping, tail force and power, governor and inflow in any descent: from hover, 10 s at 50 Hz, RK4
with 4 steps a sample, small steps of all sticks, 1024 vehicles that differ in Ixx, on one core.
"""

import ctypes
from collections.abc import Callable

import helicopter as consistent
import jax
import jax.numpy as jnp
import numpy as np
from kernels import compiled, pointer

from heli_jax import models, trim

consistent.MODEL = MODEL = models.helicopter()
IN_C = (*consistent.IN_C, "I_beta", "k_beta", "K_mu", "h_T", "K_P", "K_I", "Omega")
"""The vehicle's constants in the order of the C kernel's."""
SIZES = {"x_roll": 2e-4, "x_pitch": 2e-4, "x_yaw": 0.02, "x_collective": 0.01, "x_throttle": 0.0}


def hover_and_steps() -> consistent.Run:
    at, k = trim(MODEL, consistent.VEHICLE), np.arange(consistent.N)
    sign = np.where(k // 100 % 2 == 0, 1.0, -1.0)
    steps = {
        n: jnp.asarray(float(getattr(at.inputs, n)) + size * sign * (k // 25 % 4 == i))
        for i, (n, size) in enumerate(SIZES.items())
    }
    return consistent.Run(jax.tree.map(jnp.asarray, at.state), MODEL.Inputs(**steps))


def in_c(run: consistent.Run) -> Callable[[], np.ndarray]:
    kernel = compiled("full_helicopter.c")
    vehicle = np.array([float(getattr(consistent.VEHICLE, n)) for n in IN_C])
    start = np.array([float(v) for v in run.start])
    sticks = np.ascontiguousarray(np.stack([np.asarray(u) for u in run.inputs], axis=1))
    cost, size = np.zeros(consistent.VEHICLES), ctypes.c_size_t

    def call() -> np.ndarray:
        kernel.run(
            pointer(vehicle), pointer(consistent.IXX), pointer(start), pointer(sticks),
            pointer(cost), size(consistent.VEHICLES), size(consistent.N),
            ctypes.c_double(consistent.DT), ctypes.c_int(consistent.SUBSTEPS),
        )  # fmt: skip
        return cost

    return call


def main() -> None:
    run, Ixx = hover_and_steps(), jnp.asarray(consistent.IXX)
    ours, seconds = consistent.compile_time(consistent.batch(run), Ixx)
    theirs = in_c(run)
    np.testing.assert_allclose(ours(Ixx), theirs(), rtol=1e-8)
    a, b, ratio = consistent.in_turn(lambda: ours(Ixx), theirs, 5)
    print(f"ours {1e3 * a:.0f} ms, in C {1e3 * b:.0f} ms, ratio {ratio:.2f} (target <= 1.6)")
    print(f"compilation {seconds:.1f} s")


if __name__ == "__main__":
    main()
