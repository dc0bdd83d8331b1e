"""The command control, vehicles of a posterior, and tuning."""

import csv
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import linear_model, naming, run_fit
from heli_jax.cli.commands import main
from heli_jax.config.controller_file import read_controller
from heli_jax.control.controller import signals_of
from heli_jax.control.laws import content_of
from heli_jax.control.posterior import draws, vehicles_of
from heli_jax.control.regulators import lqr
from heli_jax.control.tune import Scenario, Tuning, tune
from heli_jax.errors import InputError
from heli_jax.identification.result import Estimate

DT = 0.02
CONFIGS = Path(__file__).parents[2] / "configs"
CONFIG = """
model: {linear: roll-flybarless}
control:
  law: %s
  rate: 50
  max_steps: %d
  duration: 2
  signals:
    phi: {most: 10, unit: deg, step: 5}
    p: {most: 1.0}
  inputs: {lat: {most: 0.05}}
  gusts: {lat: {sd: 0.005}}
"""


def run(tmp_path, text, *more):
    config = tmp_path / "control.yaml"
    config.write_text(text)
    return main(["control", str(config), "--out", str(tmp_path / "out"), "--quiet", *more])


def test_a_regulator_of_a_linear_model_in_one_command(tmp_path, capsys):
    assert run(tmp_path, CONFIG % ("lqr", 3)) in (0, 4)
    content = json.loads((tmp_path / "out" / "control.json").read_text())
    assert content["stable"] == 1.0
    assert set(content["loops"]) == {"lat"}
    assert content["tuning"]["cost"][1] <= content["tuning"]["cost"][0]
    rows = list(csv.reader((tmp_path / "out" / "gains.csv").read_text().splitlines()))
    assert {n: float(v) for n, v in rows[1:]} == content["gains"]
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
    assert "stable" in capsys.readouterr().out


LOOP = """
model: {linear: roll-flybarless}
controller: out
vehicle: {Lb: 100.0, Blat: 1.0}
simulate:
  duration: 12
  rate: 50
  inputs: {set_phi: {kind: doublet, amplitude: 0.3}}
  noise: {p: {sd: 0.005}, phi: {sd: 0.002}}
"""


def test_a_plant_is_identified_through_the_controller_of_a_run(tmp_path):
    """The sticks that the controller moves are not in the log."""
    assert run(tmp_path, (CONFIG % ("lqr", 0)).replace("gusts: {lat: {sd: 0.005}}", "")) == 0
    made = json.loads((tmp_path / "out" / "control.json").read_text())["controller"]
    law = read_controller(tmp_path / "out")
    assert content_of(law) == made
    config, log = tmp_path / "loop.yaml", tmp_path / "log.csv"
    config.write_text(LOOP)
    assert main(["simulate", str(config), "--out", str(log), "--quiet"]) == 0
    fitted = (
        LOOP
        + """
flights:
- log: log.csv
  signals:
    time: {signal: time, unit: s}
    inputs: {lat: {signal: lat}, set_phi: {signal: set_phi}}
    outputs: {p: {signal: p}, phi: {signal: phi}}
fit:
  method: output-error
  free: {Lb: {start: 60.0}}
"""
    )
    config.write_text(fitted)
    found = run_fit(config)
    e = found.fit.estimates["Lb"]
    assert found.fit.status == "converged"
    assert abs(e.value - 100.0) < 4.0 * e.sd < 10.0
    config.write_text(LOOP.replace("rate: 50", "rate: 100"))
    assert main(["simulate", str(config), "--out", str(tmp_path / "b.csv"), "--quiet"]) == 2
    config.write_text(fitted)
    (tmp_path / "out" / "control.json").write_text('{"controller": {"law": "Cascade"}}')
    with pytest.raises(InputError, match=r"control\.json"):
        run_fit(config)


def test_gains_of_rate_and_angle_loops_for_autopilots(tmp_path):
    text = """
model: {linear: roll-flybarless}
control:
  law: pid
  rate: 100
  max_steps: 0
  duration: 1
  signals: {phi: {most: 10, unit: deg, step: 5}}
  inputs: {lat: {most: 0.05, full_stick: 0.2}}
  loops: {lat: {phi: 2.0, p: 8.0}}
"""
    assert run(tmp_path, text) == 0
    assert not (tmp_path / "out" / "ardupilot.param").exists()  # no signal named roll


@pytest.mark.slow
def test_flights_that_diverge_are_a_doubt(tmp_path):
    """Margins are those of small deviations."""
    text = """
model: helicopter
vehicle: %s
control:
  law: lqr
  rate: 50
  max_steps: 0
  duration: 6
  signals:
    x: {most: 0.1, unit: m, step: 40}
    y: {most: 0.1, unit: m}
    z: {most: 0.1, unit: m}
    psi: {most: 10, unit: deg}
  inputs:
    x_roll: {most: 40, unit: mm}
    x_pitch: {most: 40, unit: mm}
    x_yaw: {most: 0.5}
    x_collective: {most: 0.2}
""" % (CONFIGS / "vehicles" / "x-cell-60.yaml")
    assert run(tmp_path, text) == 4
    content = json.loads((tmp_path / "out" / "control.json").read_text())
    assert content["stable"] == 1.0
    assert any("diverge" in words for words in content["doubts"])
    moving = text.replace("duration: 6", "duration: 6\n  start: {forward_speed: 8}")
    moving = moving.replace("step: 40", "step: 1")
    assert run(tmp_path / "..", moving) == 2


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (("law: lqr", "law: pid"), "loops"),
        (("law: lqr", "law: lqg"), "sensors"),
        (("inputs: {lat", "inputs: {stick"), "control.inputs"),
        (("p: {most", "speed: {most"), "control.signals"),
        (("most: 1.0", "most: 0.0"), "most"),
        (("gusts: {lat", "gusts: {wind_x"), "wind"),
        (("duration: 2", "duration: 0.01"), "duration"),
        (("rate: 50", "rate: 50\n  fit: nowhere"), "nowhere"),
        (("rate: 50", "rate: 50\n  integral: [phi]"), "integral"),
        (("rate: 50", "rate: 50\n  noise: {p: 0.1}"), "noise"),
        (("law: lqr", "law: lqg\n  sensors: {p: {sd: 0.1}}"), "noise"),
        (("most: 1.0", "most: 1.0, limit: 1.0"), "limit"),
    ],
)
def test_wrong_configurations_end_in_one_sentence(tmp_path, capsys, change, place):
    assert run(tmp_path, (CONFIG % ("lqr", 0)).replace(*change)) == 2
    err = capsys.readouterr().err
    assert place in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


class _Fitted:
    """Estimates with a correlation, as a fit has them."""

    def __init__(self, estimates, correlation):
        self.estimates = estimates
        self.content = {"verdict": {"names": list(estimates), "correlation": correlation}}


def estimate(value, sd, low, high):
    fields = dict.fromkeys(Estimate._fields, None)
    return Estimate(**{**fields, "value": value, "sd": sd, "lower95": low, "upper95": high})


def test_draws_have_the_intervals_and_the_correlation_of_the_fit():
    z = 1.959963984540054
    log = estimate(2.0, 0.4, 2.0 * np.exp(-0.2 * z), 2.0 * np.exp(0.2 * z))
    plain = estimate(-1.0, 0.5, -1.0 - 0.5 * z, -1.0 + 0.5 * z)
    found = draws(_Fitted({"a": log, "b": plain}, [[1.0, 0.8], [0.8, 1.0]]), 20_000, seed=1)
    assert (found["a"][0], found["b"][0]) == (2.0, -1.0)
    both = np.stack([np.log(found["a"] / 2.0), found["b"]])
    np.testing.assert_allclose(both.std(axis=1), [0.2, 0.5], rtol=0.03)
    assert np.corrcoef(both)[0, 1] == pytest.approx(0.8, abs=0.01)
    for unknown in (estimate(1.0, None, None, None), estimate(1.0, 0.1, None, None)):
        with pytest.raises(ValueError, match="expected"):
            draws(_Fitted({"a": unknown}, [[1.0]]), 10)


@pytest.fixture(scope="module")
def tuning():
    found = linear_model("roll")
    model, params = found.model, found.vehicle().params
    rng = np.random.default_rng(2)
    values = {"Lb": float(params.Lb) * np.exp(np.r_[0.0, 0.3 * rng.standard_normal(5)])}
    vehicles, flights, lost = vehicles_of(model, params, values)
    assert lost == 0
    first = jax.tree.map(lambda v: v[0], flights)
    most = {"phi": 0.02, "lat": 0.2}
    law = lqr(model, params, first, most=most, dt=DT, references=("phi",))
    scenario = Scenario({}, {"phi": 0.1 * np.ones(150)}, 150)
    return model, vehicles, flights, law, scenario, most


def test_the_gradient_of_the_cost_is_a_difference(tuning):
    model, vehicles, flights, law, scenario, most = tuning
    of = Tuning(model, vehicles, flights, law, scenario, most)
    gains = {f"controller_gains_lat_{n}": jnp.asarray(v) for n, v in law.gains["lat"].items()}
    cost = jax.jit(of.cost)
    slope = jax.jit(jax.grad(of.cost))(gains)
    for name, value in gains.items():
        h = 1e-5 * abs(float(value)) + 1e-9
        up, down = (float(cost({**gains, name: value + s * h})) for s in (1, -1))
        assert float(slope[name]) == pytest.approx((up - down) / (2 * h), rel=1e-4, abs=1e-7)


def test_tuning_lowers_the_cost_and_keeps_the_distance(tuning):
    model, vehicles, flights, law, scenario, most = tuning
    found = tune(model, vehicles, flights, law, scenario, most=most, distance=0.6)
    assert found.converged
    assert found.cost[1] < found.cost[0]
    assert found.distance[1] >= 0.6 - 1e-3
    assert found.stable[1] == 1.0
    # The loop's distance by a simulation in NumPy: no vehicle oscillates.
    flown = Tuning(model, vehicles, flights, found.controller, scenario, most).flown(
        found.controller
    )
    assert np.all(np.abs(flown.deviations["phi"][:, -1]) < 0.01)


def test_tuning_keeps_the_bandwidth(tuning):
    model, vehicles, flights, _, scenario, most = tuning
    first = jax.tree.map(lambda v: v[0], flights)
    slow = lqr(
        model, jax.tree.map(lambda v: v[0], vehicles), first, most={"phi": 0.3, "lat": 0.05},
        dt=DT, references=("phi",),
    )  # fmt: skip
    wanted = 8.0

    def phases(controller):
        """Phases [deg] at the bandwidth, by closed-loop matrices in NumPy."""
        of = Tuning(model, vehicles, flights, controller, scenario, most)
        gains = controller.gains["lat"]
        k = np.array([[float(gains.get(n, 0.0)) for n in signals_of(model)]])
        row, z, found = signals_of(model).index("phi"), np.exp(1j * wanted * DT), []
        for i in range(6):
            A, B, C, *_ = (np.asarray(M[i]) for M in of.plants)
            x = np.linalg.solve(z * np.eye(len(A)) - A + B @ k @ C, B * k[0, row])
            found.append(np.angle((C @ x)[row, 0], deg=True))
        return np.array(found)

    found = tune(
        model, vehicles, flights, slow, scenario, most={**most, "lat": 0.01}, distance=0.4,
        bandwidth={"phi": wanted},
    )  # fmt: skip
    assert np.min(phases(slow)) < -135.0
    assert found.converged
    assert np.min(phases(found.controller)) > -135.5
    with pytest.raises(ValueError, match="set point"):
        tune(model, vehicles, flights, slow, scenario, most=most, bandwidth={"p": 1.0})


def test_wrong_names_of_a_tuning_are_refused(tuning):
    model, vehicles, flights, law, scenario, most = tuning
    for flown, weights in (
        (scenario, {"speed": 1.0}),
        (scenario._replace(inputs={"wind_x": np.zeros(150)}), most),
        (scenario._replace(set_points={"p": np.zeros(150)}), most),
    ):
        with pytest.raises(ValueError, match="no"):
            tune(model, vehicles, flights, law, flown, most=weights)


def test_a_vehicle_that_moves_at_zero_is_refused():
    found = linear_model("roll")
    params = naming.replace(found.vehicle().params)
    vehicles, flights, lost = vehicles_of(found.model, params, {})
    assert lost == 0
    assert jax.tree.leaves(vehicles)[0].shape == (1,)
    assert jax.tree.leaves(flights)[0].shape == (1,)
