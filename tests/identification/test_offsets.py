"""Sticks that are not centred: a constant offset of each input in each flight."""

from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit, models
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.unknowns.layout import layout_of
from heli_jax.naming import Scalar
from tests.identification.bench import BENCH, amplitude_for, response, steps, vehicle

FREE = {"Ixx": Free(0.05), "If": Free(5e-4)}
DT, N = 0.02, 4000


def flown(seed: int, share: float) -> tuple[Flight, float]:
    """Return a free roll whose stick is off by a share of its amplitude, not in the log."""
    amplitude = amplitude_for(BENCH, DT, False)
    rng = np.random.default_rng(seed)
    u = steps(rng, N, DT, amplitude)
    y = response(BENCH, u + share * amplitude, DT, False) + 2e-3 * rng.standard_normal(N)
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y}), share * amplitude


def test_an_offset_of_the_stick_does_not_move_the_inertia():
    flight, offset = flown(3, 0.03)
    found = fit(Problem(models.roll, vehicle(BENCH), [flight], FREE))
    assert found.white
    for name in FREE:
        e = found.estimates[name]
        assert e.lower95 < BENCH[name] < e.upper95
        assert e.sd < 0.01 * e.value
    e = found.nuisance["flight 1/offset x_roll"]
    assert e.unit == "m"
    assert e.value == pytest.approx(offset, abs=4 * e.sd)
    assert e.sd < 0.02 * offset


class Params(NamedTuple):
    Lp: Annotated[Scalar, "1/s", "damping"]
    Ld: Annotated[Scalar, "1/s^2", "effectiveness"]
    L0: Annotated[Scalar, "rad/s^2", "constant"]


class State(NamedTuple):
    p: Annotated[Scalar, "rad/s", "rate"]
    phi: Annotated[Scalar, "rad", "angle"]


class Inputs(NamedTuple):
    d: Annotated[Scalar, "1", "stick"]


AIRCRAFT = Model(
    "aircraft-roll",
    lambda p, s, u: State(p=p.Lp * s.p + p.Ld * u.d + p.L0, phi=s.p),
    lambda p, s, u: s,
    Params, State, Inputs, State,
)  # fmt: skip


def problem_of(free: dict[str, Free], outputs: tuple[str, ...], nuisance: Nuisance) -> Problem:
    rng = np.random.default_rng(0)
    signals = {n: rng.standard_normal(100) for n in outputs}
    flight = Flight(dt=0.1, inputs={"d": rng.standard_normal(100)}, outputs=signals)
    params = Params(*(jnp.asarray(v) for v in (-3.0, 10.0, 0.0)))
    return Problem(AIRCRAFT, params, [flight], free, nuisance)


@pytest.mark.parametrize(
    ("free", "outputs", "expected"),
    [
        (("Lp", "Ld"), ("phi",), ("d",)),
        (("Lp", "Ld"), ("p", "phi"), ("d",)),
        (("Lp", "Ld"), ("p",), ()),  # the bias absorbs it
        (("Lp", "Ld", "L0"), ("phi",), ()),  # a parameter represents it
    ],
)
def test_where_the_offset_is_estimated_unless_told(free, outputs, expected):
    starts = {n: Free(s) for n, s in (("Lp", -2.0), ("Ld", 5.0), ("L0", 0.1)) if n in free}
    assert problem_of(starts, outputs, Nuisance()).offset_inputs == expected
    assert problem_of(starts, outputs, Nuisance(input_offset=True)).offset_inputs == ("d",)
    assert problem_of(starts, outputs, Nuisance(input_offset=False)).offset_inputs == ()
    assert problem_of(starts, outputs, Nuisance(input_offset=("d",))).offset_inputs == ("d",)


def test_an_offset_that_drives_an_unstable_mode_is_no_bias():
    for damping, expected in ((-2.0, ()), (2.0, ("d",))):
        free = {"Lp": Free(damping), "Ld": Free(5.0)}
        assert problem_of(free, ("p",), Nuisance()).offset_inputs == expected


def test_a_stand_takes_the_offset_up_in_the_bias():
    rng = np.random.default_rng(0)
    flight = Flight(dt=DT, inputs={"x_roll": steps(rng, N, DT, 1e-6)}, outputs={"roll": np.ones(N)})
    assert Problem(models.roll_on_stand, vehicle(BENCH), [flight], FREE).offset_inputs == ()
    limp = vehicle(BENCH | {"kappa": 0.0})
    assert Problem(models.roll_on_stand, limp, [flight], FREE).offset_inputs == ("x_roll",)


def test_the_scale_of_the_offset_is_that_of_the_stick():
    flight, _ = flown(3, 0.0)
    problem = Problem(models.roll, vehicle(BENCH), [flight], FREE)
    data, layout = data_of(problem, problem.training), layout_of(problem, problem.training)
    assert layout.size == len(FREE) + 4 + 1 + 1
    scale = float(data.flights[0].offset_scale["x_roll"])
    assert scale == pytest.approx(10 * np.std(flight.inputs["x_roll"]))
