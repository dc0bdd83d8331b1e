"""A flybar whose paddle has its own chord and lift slope."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from heli_jax import Free, Problem, fit, load_vehicle, models, naming
from heli_jax.dynamics.flybar import flapping_rate_gain, flybar_time_constant
from heli_jax.dynamics.model import missing_parameters, reads
from heli_jax.dynamics.roll import ratios_from_denominator, roll_transfer_function
from heli_jax.errors import InputError
from heli_jax.identification.equation_error.rls import baseline
from tests.identification.bench import BENCH, denominators, record, response, vehicle
from tests.responses import polynomials

C, A = 0.03, 3.4
FACTOR = A * C / (BENCH["a"] * BENCH["c"])
"""Ratio of the paddle's lift to the paper's."""
OWN = {**BENCH, "If": BENCH["If"] / FACTOR}
"""Paper's vehicle with the same motion: only If is larger."""


def with_paddle(**more):
    return naming.replace(vehicle(BENCH), c_paddle=C, a_paddle=A, **more)


@pytest.mark.parametrize("stand", [False, True])
def test_a_smaller_paddle_is_a_larger_flybar(stand):
    """Test against the independent program with If larger by the lift ratio."""
    p = with_paddle()
    model = models.roll_on_stand if stand else models.roll
    num, den = polynomials(model, p)
    wanted = denominators(OWN, stand)
    np.testing.assert_allclose(num[1:], wanted[0], rtol=1e-9)
    np.testing.assert_allclose(den, wanted[1], rtol=1e-9, atol=1e-9 * np.abs(den).max())
    closed = roll_transfer_function(p, stand=stand)
    np.testing.assert_allclose(closed.den, wanted[1], rtol=1e-9, atol=1e-9 * np.abs(den).max())
    assert float(flybar_time_constant(p, 150.0)) * FACTOR == pytest.approx(
        float(flybar_time_constant(vehicle(BENCH), 150.0))
    )


@pytest.mark.parametrize(
    ("given", "factor"),
    [({"c_paddle": C}, C / BENCH["c"]), ({"a_paddle": A}, A / BENCH["a"]), ({}, 1.0)],
)
def test_either_may_be_given_alone(given, factor):
    v = vehicle(BENCH)
    found = float(flapping_rate_gain(naming.replace(v, **given)))
    assert found == pytest.approx(factor * float(flapping_rate_gain(v)), rel=1e-14)


def test_a_vehicle_need_not_give_them(tmp_path, vehicles_folder):
    v = vehicle(BENCH)
    assert missing_parameters(models.roll, v) == []
    assert reads(models.roll, v, "c_paddle")
    assert reads(models.roll, v, "a_paddle")
    assert not reads(models.roll, v, "hr")
    content = yaml.safe_load((vehicles_folder / "bench-30.yaml").read_text())
    path = tmp_path / "v.yaml"
    path.write_text(yaml.safe_dump({**content, "c_paddle": {"value": 30, "unit": "mm"}}))
    assert float(load_vehicle(path).c_paddle) == pytest.approx(0.03)
    path.write_text(yaml.safe_dump({**content, "a_paddle": 0.0}))
    with pytest.raises(InputError, match="a_paddle must be more than zero, got 0"):
        load_vehicle(path)


def flight(noise=2e-3):
    """Return a run of the vehicle with the small paddle, by the independent program."""
    made = record(OWN, seed=6, n=1000, dt=0.02, noise=noise)
    return dataclasses.replace(made)


FREE = {"Ixx": Free(0.05), "If": Free(5e-4), "a": Free(4.0)}


def test_a_fit_finds_the_flybar_that_was_swung():
    free = {"Ixx": FREE["Ixx"], "If": FREE["If"]}
    found = fit(Problem(models.roll_on_stand, with_paddle(), [flight()], free)).estimates["If"]
    assert found.sd is not None
    assert abs(found.value - BENCH["If"]) < 4 * found.sd
    assert found.sd < 0.02 * BENCH["If"]


def test_the_ratios_of_a_denominator_are_those_of_the_paddle():
    p = with_paddle()
    den = denominators(OWN, True)[1]
    found = ratios_from_denominator(p, den).values
    assert set(found) == {"a/Ixx", "a_paddle/If"}
    assert float(found["a_paddle/If"]) == pytest.approx(A / BENCH["If"], rel=1e-6)
    assert float(found["a/Ixx"]) == pytest.approx(BENCH["a"] / BENCH["Ixx"], rel=1e-6)
    only_chord = ratios_from_denominator(naming.replace(p, a_paddle=jnp.nan), den).values
    assert set(only_chord) == {"a/Ixx", "a/If"}


def test_the_baseline_names_the_ratio_that_it_finds():
    made = flight(noise=0.0)
    quiet = response(OWN, made.inputs["x_roll"], made.dt, True)
    made = dataclasses.replace(made, outputs={"roll": quiet})
    found = baseline(models.roll_on_stand, with_paddle(), made).combinations
    assert "a/If" not in found
    assert found["a_paddle/If"] == pytest.approx(A / BENCH["If"], rel=0.05)
