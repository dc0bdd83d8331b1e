"""A stick whose steps stand at the stamp after them is said to be late, and by how much.

Records are made by SciPy at 1 kHz and logged at 50 Hz.
"""

import numpy as np
import pytest

from heli_jax import Flight, Free, Nuisance, Problem, check, fit
from heli_jax.flights.holds import decide
from tests.identification.lag import LAG, Params, response

FINE, EVERY = 0.001, 20
LOGGED = FINE * EVERY
N = 40_000


def problem(grid, *, shift=False, start=(-6.0, 20.0)):
    """Steps at multiples of `grid` [ms], the stick read at the logger's samples."""
    rng = np.random.default_rng(5)
    u, k = np.zeros(N), 0
    while k < N:
        n = grid * int(rng.integers(150 // grid, 600 // grid))
        u[k : k + n] = rng.uniform(-0.1, 0.1)
        k += n
    p = response(-12.0, 60.0, u, FINE)[::EVERY]
    p = p + 0.002 * rng.standard_normal(p.size)
    stick = u[::EVERY]
    taken = decide(stick)
    flight = Flight(
        dt=LOGGED, inputs={"d": stick}, outputs={"p": p},
        hold={"d": taken.hold}, hold_reason={"d": taken.reason},
    )  # fmt: skip
    free = {"Lp": Free(start[0]), "Ld": Free(start[1])}
    return Problem(LAG, Params(*start), [flight], free, Nuisance(time_shift=shift))


def late_ones(found):
    return [f for f in found.findings if f.code == "timing.late-input"]


def test_a_stick_that_is_late_takes_the_interval_that_it_moves():
    found = fit(problem(1))
    [late] = late_ones(found)
    assert late.subjects == ("d",)
    # Half of the logger's 20 ms on average, of the derivative at the optimum.
    assert 0.005 < late.value < 0.014
    # True is -12: the shift is towards it.
    lp = found.estimates["Lp"]
    assert lp.value + late.shifts["Lp"] == pytest.approx(-12.0, rel=0.1)
    assert abs(late.shifts["Lp"]) > 1.96 * lp.sd
    assert found.distrusts["Lp"].shift == late.shifts["Lp"]
    assert (lp.lower95, lp.upper95) == (None, None)
    assert found.exit_code == 3


def test_a_free_shift_leaves_what_each_step_was_late_by():
    found = fit(problem(1, shift=True))
    assert found.nuisance["time_shift"].value == pytest.approx(-0.01, abs=0.002)
    [late] = [f for f in found.findings if f.code == "timing.steps-between-stamps"]
    assert (late.severity, late.subjects) == ("note", ("d",))
    assert late.value == pytest.approx(0.01, abs=0.002)


def test_a_stick_whose_steps_fall_on_samples_is_not():
    found = fit(problem(EVERY))
    assert not late_ones(found)
    assert found.exit_code == 0
    assert found.interval == "95 % interval"
    assert found.estimates["Lp"].value == pytest.approx(-12.0, rel=0.02)


def test_check_says_what_half_a_sample_of_the_stick_does():
    found = check(problem(1, start=(-14.0, 70.0))).findings
    [finding] = [f for f in found if f.code == "timing.slow-stick"]
    assert finding.severity == "doubt"
    # exp(Lp t) is as much off by 10 ms as Lp is by a tenth or two.
    assert 0.1 < finding.value < 0.3
