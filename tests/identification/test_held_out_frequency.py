"""Held-out flights in frequency: other vehicles and signs, and flights that cannot be judged."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Problem, fit, linear_model, linearize, models
from heli_jax.analysis.spectra import ResponseOptions
from heli_jax.identification.validation.held_out import HeldOutFlight
from heli_jax.report.card import card
from heli_jax.report.files import fit_json
from tests.identification.bench import BENCH, amplitude_for, record, vehicle

FREE = {"Ixx": Free(0.03), "If": Free(1.4e-4), "kappa": Free(5.0)}
N, HELD = 3000, 2000
HEAVY = {**BENCH, "Ixx": 1.1 * BENCH["Ixx"]}
AMPLITUDE = amplitude_for(BENCH, 0.02, True)


def held(seed: int, name: str, v: dict[str, float] = BENCH, noise: float = 2e-3) -> Flight:
    more = {"noise": noise, "amplitude": AMPLITUDE, "hold_out": True, "name": name}
    return record(v, seed=seed, n=HELD, **more)


def turned(flight: Flight, name: str) -> Flight:
    return dataclasses.replace(flight, outputs={"roll": -flight.outputs["roll"]}, name=name)


@pytest.fixture(scope="module")
def flights() -> list[Flight]:
    same = held(11, "same")
    return [
        record(BENCH, seed=1, n=N),
        same,
        held(12, "noisy", noise=4e-3),
        held(13, "heavy", HEAVY),
        turned(held(14, "turned"), "turned"),
        dataclasses.replace(same, dt=0.01, name="other rate"),
        dataclasses.replace(same, outputs={"roll_rate": same.outputs["roll"]}, name="rates"),
        dataclasses.replace(
            same,
            outputs={**same.outputs, "roll_rate": same.outputs["roll"]},
            sd={"roll_rate": 0.01},
            name="both",
        ),
    ]


@pytest.fixture(scope="module")
def found(flights):
    problem = Problem(models.roll_on_stand, vehicle(BENCH), flights, FREE, method="frequency-error")
    return fit(problem), problem


def of(found, name: str) -> HeldOutFlight:
    [one] = [f for f in found[0].held_out_frequency.flights if f.flight == name]
    return one


def test_noise_that_is_stronger_is_no_other_machine(found):
    for name in ("same", "noisy", "both"):
        one = of(found, name)
        assert not one.differs
        assert one.explained["roll"] > 0.99
        assert not one.worse
        assert not [f for f in found[0].findings if name in f.subjects]


def test_another_machine_is_told_with_the_estimate_that_it_asks_for(found):
    one = of(found, "heavy")
    assert one.differs
    assert one.furthest.parameter == "Ixx"
    assert one.furthest.own == pytest.approx(HEAVY["Ixx"], rel=0.03)
    assert one.furthest.fitted == pytest.approx(BENCH["Ixx"], rel=0.01)
    [said] = [f for f in found[0].findings if f.subjects == ("heavy",)]
    assert said.code == "held-out.other-estimates"
    assert said.shifts == {"Ixx": one.furthest.own - one.furthest.fitted}
    # A tenth of Ixx is many sds: whichever flight is right, the interval excludes one of them.
    assert said.severity == "doubt"
    assert found[0].distrusts["Ixx"].code == said.code


def test_a_model_that_is_worse_than_none_is_no_result(found):
    one = of(found, "turned")
    assert one.worse == ("roll",)
    assert one.explained["roll"] < 0.0
    [said] = [f for f in found[0].findings if f.denies]
    assert (said.code, said.subjects) == ("held-out.worse-than-none", ("turned", "roll"))
    assert found[0].exit_code == 4


def test_what_cannot_be_compared_is_left_out(found):
    assert found[0].held_out_frequency.not_judged == ("rates",)
    assert [f.subjects for f in found[0].findings if f.code == "held-out.not-judged"] == [
        ("rates",)
    ]
    # An output that no fitted flight has is left out.
    assert of(found, "both").explained == pytest.approx(of(found, "same").explained, rel=1e-9)


def test_it_stands_in_fit_json(found):
    content = fit_json(*found, None)["held_out_frequency"]["flights"]
    assert [f["flight"] for f in content][:2] == ["same", "noisy"]
    assert content[2]["furthest"]["parameter"] == "Ixx"


def test_the_card_asks_of_them_what_no_simulation_tells(found):
    """Test the acceptance card at exit code 4, of which all gates had passed."""
    lines = card(found[0])
    own = {g.of: g for g in lines if g.what == "its own estimates, p-value"}
    assert own["same, held out"].passed
    assert own["heavy, held out"].passed is False
    explained = {g.of: g.passed for g in lines if g.what == "explained"}
    assert explained["roll, same, held out"]
    assert explained["roll, turned, held out"] is False


@pytest.mark.slow
def test_by_responses_a_flight_without_the_instrument_of_the_fit_is_not_judged():
    """Test responses of feedback, which were taken for another vehicle (p below 1e-6)."""
    roll, dt, n = linear_model("roll-flybarless"), 0.02, 3000
    params, rng = roll.vehicle().params, np.random.default_rng(3)
    matrices = linearize(roll.model, params).matrices
    Ad = scipy.linalg.expm(np.block([[matrices.A, matrices.B], [np.zeros((1, 4))]]) * dt)
    t = np.arange(n) * dt
    sweep = 0.05 * np.sin(2 * np.pi * (0.2 * t + 0.04 * t**2))
    made = []
    for name in ("fitted", "same", "bare", "off"):
        x, gust, u, p = np.zeros(3), 0.0, np.zeros(n), np.zeros(n)
        for k in range(n):
            asked = 0.0 if name in ("bare", "off") else sweep[k]
            p[k], u[k] = x[1], asked - 0.8 * x[0]
            gust = 0.96 * gust + 0.005 * rng.standard_normal()
            x = (Ad @ np.append(x, u[k]))[:3]
            x[1] += gust
        p += 2e-3 * rng.standard_normal(n)
        own = sweep if name in ("fitted", "same") else np.zeros(n)
        logged = {} if name == "bare" else {"lat": own}
        made.append(
            Flight(
                dt=dt, inputs={"lat": u}, outputs={"p": p}, instruments=logged, name=name,
                hold_out=name != "fitted",
            )
        )  # fmt: skip
    found = fit(
        Problem(
            roll.model, params, made, {"Lb": Free(100.0), "Blat": Free(0.1)},
            method="frequency-response", frequency=ResponseOptions(band=(0.3, 4.0), window=10.0),
        )
    )  # fmt: skip
    [one] = found.held_out_frequency.flights
    assert one.flight == "same"
    assert not one.differs
    assert found.held_out_frequency.not_judged == ("bare", "off")
