"""Flights held out, judged in frequency: against sums of squares in time, other machines and signs,
and what cannot be judged."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Problem, fit, linear_model, linearize, models
from heli_jax.analysis.response_options import ResponseOptions
from heli_jax.identification.validation.held_out_agreement import HeldOutFlight
from heli_jax.report import statements, tables
from heli_jax.report.card import card, failed
from heli_jax.report.files import fit_json
from tests.identification.bench import BENCH, amplitude_for, record, response, vehicle
from tests.identification.test_frequency_error import FALLING

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


def test_in_white_noise_chi_squared_is_that_of_the_residuals_in_time(found, flights):
    fitted = flights[0]
    sd = np.std(fitted.outputs["roll"] - response(BENCH, fitted.inputs["x_roll"], 0.02, True))
    for name, size in (("same", 1.0), ("noisy", 4.0)):
        [flight] = [f for f in flights if f.name == name]
        left = flight.outputs["roll"] - response(BENCH, flight.inputs["x_roll"], 0.02, True)
        by_hand = np.var(left) / sd**2
        one = of(found, name)
        # The spectrum of the fitted flight follows chance where that has few lines.
        assert one.chi_squared == pytest.approx(by_hand, rel=0.03)
        assert by_hand == pytest.approx(size, rel=0.1)
        assert (one.lower95 < one.chi_squared < one.upper95) == (name == "same")
        # Noise that is stronger is no other machine.
        assert not one.differs
        assert one.explained["roll"] > 0.99
        assert not one.worse
    bands = [b for b in found[0].held_out_frequency.bands if b.output == "roll"]
    assert bands[0].low == pytest.approx(1.0 / (HELD * 0.02))
    assert all(b.low < b.high and b.lower95 < 1.0 < b.upper95 for b in bands)


def test_another_machine_is_told_with_the_estimate_that_it_asks_for(found):
    one = of(found, "heavy")
    assert one.differs
    assert one.furthest.parameter == "Ixx"
    assert one.furthest.own == pytest.approx(HEAVY["Ixx"], rel=0.03)
    assert one.furthest.fitted == pytest.approx(BENCH["Ixx"], rel=0.01)
    [said] = [f for f in found[0].findings if f.subjects == ("heavy",)]
    assert said.code == "held-out.other-estimates"
    assert said.shifts == {"Ixx": one.furthest.own - one.furthest.fitted}
    # A tenth of Ixx is many of its sds: whichever flight is right, the interval does not hold both.
    assert said.severity == "doubt"
    assert found[0].distrusts["Ixx"].code == said.code


def test_a_model_that_is_worse_than_none_is_no_result(found):
    one = of(found, "turned")
    assert one.worse == ("roll",)
    assert one.explained["roll"] < 0.0
    [said] = [f for f in found[0].findings if f.denies]
    assert (said.code, said.subjects) == ("held-out.worse-than-none", ("turned", "roll"))
    assert found[0].exit_code == 4
    assert statements.headline(found[0]).level == "bad"


def test_what_cannot_be_compared_is_said(found):
    notes = found[0].held_out_frequency.notes
    assert any("no fitted flight has its sample time" in n for n in notes)
    assert any("none of the outputs that were fitted (roll)" in n for n in notes)
    # An output that no fitted flight has is left out.
    assert of(found, "both").chi_squared == pytest.approx(of(found, "same").chi_squared, rel=1e-9)


def test_it_stands_in_fit_json_and_in_tables(found):
    content = fit_json(*found, None)["held_out_frequency"]
    assert [f["flight"] for f in content["flights"]][:2] == ["same", "noisy"]
    assert content["flights"][2]["furthest"]["parameter"] == "Ixx"
    assert content["flights"][0]["responses"] is None
    held_out = found[0].held_out_frequency
    table = tables.held_out_flights(held_out)
    assert len(table.rows) == 5
    assert table.head[-1] == "explained"
    assert any("differ (p below 1·10⁻⁶)" in row for row in table.rows)
    assert of(found, "turned").in_words.endswith("of what follows the excitation: roll none")
    assert len(tables.held_out_bands(held_out).rows) == len(held_out.bands)


@pytest.mark.slow
def test_flights_held_out_may_have_other_outputs_each_and_some_that_never_move(flights):
    fitted, both, same = flights[0], flights[-1], flights[1]
    still = np.zeros(HELD)
    dead = dataclasses.replace(both, outputs={**both.outputs, "roll": still + 0.1}, name="dead")
    resting = dataclasses.replace(
        same, inputs=dict.fromkeys(same.inputs, still), outputs={"roll": still}, name="resting"
    )
    held_out = [both, same, dead, resting]
    problem = Problem(
        models.roll_on_stand, vehicle(BENCH), [fitted, *held_out], FREE, method="frequency-error"
    )
    said = fit(problem).held_out_frequency
    assert [f.flight for f in said.flights] == ["both", "same"]
    assert [n for n in said.notes if "none of its outputs (roll) ever moves" in n] == list(
        said.notes
    )
    assert len(said.notes) == 2


def test_the_card_asks_of_them_what_no_simulation_tells(found):
    """Beside exit code 4 stood a card of which all gates were passed."""
    lines = card(found[1], found[0])
    own = {g.of: g for g in lines if g.what == "its own estimates, p-value"}
    assert own["same, held out"].passed
    assert own["heavy, held out"].passed is False
    assert own["heavy, held out"].words == "below 1e-6"
    assert any("below 1·10⁻⁶" in row for row in tables.acceptance(lines).rows)
    explained = {g.of: g.passed for g in lines if g.what == "explained"}
    assert explained["roll, same, held out"]
    assert explained["roll, turned, held out"] is False


def test_squared_errors_alone_are_a_note(found):
    [said] = of(found, "noisy").findings
    assert (said.code, said.severity, said.denies) == ("held-out.size", "note", False)
    assert said.value == of(found, "noisy").chi_squared
    assert of(found, "same").findings == []


def test_flights_of_other_outputs_cannot_be_fitted_together(flights):
    other = dataclasses.replace(flights[-1], hold_out=False)
    with pytest.raises(ValueError, match="both: output roll_rate is not in every flight"):
        fit(
            Problem(
                models.roll_on_stand, vehicle(BENCH), [flights[0], other], FREE,
                method="frequency-error",
            )
        )  # fmt: skip


@pytest.mark.slow
def test_by_responses_each_flight_has_its_own_noise_and_j(flights):
    names = ("same", "noisy", "turned")
    chosen = [flights[0], *(f for f in flights if f.name in names)]
    still = {"roll": np.full(HELD, 0.1)}
    chosen.append(dataclasses.replace(flights[1], name="dead", outputs=still))
    short = [
        dataclasses.replace(
            flights[1],
            name="short",
            inputs={n: u[:300] for n, u in flights[1].inputs.items()},
            outputs={n: y[:300] for n, y in flights[1].outputs.items()},
        )
    ]
    problem = Problem(
        models.roll_on_stand, vehicle(BENCH), chosen + short, FREE,
        method="frequency-response", frequency=ResponseOptions(window=8.0, band=(0.25, 8.0)),
    )  # fmt: skip
    found = fit(problem), problem
    for name in ("same", "noisy"):
        one = of(found, name)
        assert one.lower95 < one.chi_squared < one.upper95
        assert not one.differs
        [pair] = one.responses.pairs
        assert pair.J < 100.0
        assert pair.of_none > 100.0
    wrong = of(found, "turned")
    assert wrong.differs
    assert wrong.worse == ("roll",)
    assert wrong.responses.pairs[0].J > 1000.0
    assert any(n.startswith("short, held out: not judged") for n in found[0].notes)
    assert "dead, held out: not judged in frequency: none of its outputs (roll) ever moves." in (
        found[0].notes
    )
    content = fit_json(*found, None)["held_out_frequency"]
    assert content["flights"][0]["responses"]["pairs"][0]["output"] == "roll"
    # No share is asked of responses.
    assert "explained" not in tables.held_out_flights(found[0].held_out_frequency).head
    [gate] = [g for g in failed(card(problem, found[0])) if g.what == "explained"]
    assert (gate.of, gate.words) == ("roll, turned, held out", "less than none")


def test_by_responses_a_flight_without_the_instrument_of_the_fit_is_not_judged():
    """Its responses are those of feedback, and passed for another machine (p below 1e-6)."""
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
    for name in ("bare", "off"):
        words = f"{name}, held out: not judged in frequency: no instrument of lat moves in it"
        assert any(n.startswith(words) for n in found.held_out_frequency.notes)


@pytest.mark.slow
def test_an_unstable_machine_is_judged_where_no_simulation_stays(tmp_path):
    path = tmp_path / "falling.yaml"
    path.write_text(FALLING)
    model = linear_model(path)
    rng, dt = np.random.default_rng(5), 0.02
    # By Euler steps of a tenth: p' = Lp p + Lphi phi + Llat lat, held upright by the pilot.
    made = []
    for name, count in (("first", 3000), ("second", 3000)):
        p = phi = 0.0
        steps = np.repeat(rng.uniform(-1, 1, count // 20), 20) * 0.3
        y, u = np.zeros((count, 2)), np.zeros(count)
        for k in range(count):
            y[k] = p, phi
            u[k] = steps[k] - 0.8 * phi - 0.3 * p
            for _ in range(20):
                p, phi = p + dt / 20 * (-p + 2.0 * phi + 10.0 * u[k]), phi + dt / 20 * p
        y += rng.standard_normal(y.shape) * [5e-3, 2e-3]
        outputs = {"p": y[:, 0], "phi": y[:, 1]}
        made.append(
            Flight(
                dt=dt,
                inputs={"lat": u},
                outputs=outputs,
                instruments={"lat": steps},
                name=name,
                hold_out=name == "second",
            )
        )
    free = {"Lp": Free(-0.5), "Llat": Free(7.0), "Lphi": Free(1.0)}
    found = fit(Problem(model.model, model.vehicle().params, made, free, method="frequency-error"))
    [one] = found.held_out_frequency.flights
    assert one.lower95 < one.chi_squared < one.upper95
    assert not one.differs
    assert min(one.explained.values()) > 0.99
    # No simulation in time stays near it, and the first line does not speak of that.
    assert found.validation["phi"].vaf < 0.0
    assert not one.findings
