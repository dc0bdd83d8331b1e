"""Scale error of a noisy, integrated sensor, against a record made by sums."""

import dataclasses
from typing import Annotated, Any, NamedTuple

import numpy as np
import pytest

from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.identification.fit import fit
from heli_jax.identification.problem import Free, Nuisance, Problem

DT, N, NOISE, SCALE, BIAS = 0.05, 6000, 0.5, -0.03, 0.2


class Params(NamedTuple):
    scale: Annotated[Any, "1", "scale error of the sensor"] = 0.0
    bias: Annotated[Any, "m/s", "its bias"] = 0.0
    walk: Annotated[Any, "m", "sd of the position after 1 s by its noise"] = 0.0


class Position(NamedTuple):
    x: Annotated[Any, "m", "position"]


class Speed(NamedTuple):
    v: Annotated[Any, "m/s", "as the sensor shows it"]


MODEL = Model(
    "odometer",
    lambda p, s, u: Position((u.v - p.bias) / (1.0 + p.scale)),
    lambda p, s, u: s,
    Params,
    Position,
    Speed,
    Position,
    noise_intensity=lambda p: Position(p.walk / (1.0 + p.scale)),
    axes=(),
    positive=("walk",),
    explicit=True,
    input_scales=("scale",),
)


@pytest.fixture(scope="module")
def flight():
    rng, t = np.random.default_rng(3), DT * np.arange(N)
    speed = 1.2 * np.sin(0.31 * t) + 0.6 * np.cos(0.83 * t)
    x = -1.2 / 0.31 * (np.cos(0.31 * t) - 1.0) + 0.6 / 0.83 * np.sin(0.83 * t)
    shown = (1.0 + SCALE) * speed + BIAS + NOISE * rng.standard_normal(N)
    return Flight(
        dt=DT,
        inputs={"v": shown},
        outputs={"x": x + 0.1 * rng.standard_normal(N)},
        hold={"v": "linear"},
    )


def estimate(model, flight):
    free = {
        "scale": Free(0.0, sign="any"),
        "bias": Free(0.0, sign="any"),
        "walk": Free(NOISE * DT**0.5, sign="keep"),
    }
    nuisance = Nuisance(bias=False, input_offset=False)
    problem = Problem(model, Params(), [flight], free, nuisance, method="filter-error")
    found = fit(problem, starts=1).estimates
    return {n: (e.value, e.sd or 0.0) for n, e in found.items()}


@pytest.mark.slow
def test_noise_of_what_is_integrated_does_not_attenuate_its_scale(flight):
    found = estimate(MODEL, flight)
    for name, true in (("scale", SCALE), ("bias", BIAS)):
        value, sd = found[name]
        assert abs(value - true) < 2.5 * sd
    # Without the correction a regression on noisy readings is far off, as the record shows.
    value, sd = estimate(dataclasses.replace(MODEL, input_scales=()), flight)["scale"]
    assert value - SCALE > 4.0 * sd
