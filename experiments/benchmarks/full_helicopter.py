"""Speed of the variant `full` compared with the same equations in C, as in `helicopter.py`.

Flapping, tail force and power, and governor: from hover, 10 s at 50 Hz, RK4 with 4 steps a sample,
small steps of all sticks, with 1024 values of Ixx, on one core.
"""

import sys
from pathlib import Path

import helicopter as consistent
import jax.numpy as jnp
import numpy as np

from heli_jax import models

MODEL = models.helicopter()
IN_C = (*consistent.IN_C, "I_beta", "k_beta", "K_mu", "h_T", "K_P", "K_I", "Omega")
"""The vehicle's constants in the order of the C kernel."""
STICK_STEPS = {
    "x_roll": 2e-4, "x_pitch": 2e-4, "x_yaw": 0.02, "x_collective": 0.01, "x_throttle": 0.0,
}  # fmt: skip
TURNS = 5
"""Repetitions of each pair."""


def main() -> None:
    run = consistent.hover_and_steps(MODEL, STICK_STEPS)
    Ixx = jnp.asarray(consistent.IXX)
    ours, seconds = consistent.compile_time(consistent.batch(run, MODEL), Ixx)
    theirs = consistent.in_c(run, "full_helicopter.c", IN_C)
    np.testing.assert_allclose(ours(Ixx), theirs(), rtol=1e-8)
    a, b, ratio = consistent.in_turn(lambda: ours(Ixx), theirs, TURNS)
    print(f"ours {1e3 * a:.0f} ms, in C {1e3 * b:.0f} ms, ratio {ratio:.2f} (target <= 1.6)")
    print(f"compilation {seconds:.1f} s")
    as_one = consistent.fused(run, MODEL)
    np.testing.assert_allclose(as_one(), theirs(), rtol=1e-8)
    a, b, ratio = consistent.in_turn(as_one, theirs, TURNS)
    print(f"as one program {1e3 * a:.0f} ms, in C {1e3 * b:.0f} ms, {ratio:.2f} (target <= 1)")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from script import Size, asked

    TURNS = asked(__doc__, "some minutes", Size("turns", 5, 1, "how often each is timed")).turns
    main()
