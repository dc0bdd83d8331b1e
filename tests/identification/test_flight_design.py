"""Design of flights: expected accuracy by independent programs, gradients, limits, files."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Nuisance, Prior, Problem
from heli_jax.cli.commands import main
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.design.autopilots import (
    ARDUPILOT,
    ardupilot_parameters,
    betaflight_commands,
    transmitter_script,
)
from heli_jax.identification.flight_design import InputLimit, Limits, _Search, design
from heli_jax.identification.identifiability.verdict import exponents
from heli_jax.naming import asdict
from tests.identification.test_enough import FREE, SWING, TRUTH

DT, N, SD = 0.02, 400, 1e-3
RANDOM = 0.2 * np.sign(np.random.default_rng(3).standard_normal(N // 20)).repeat(20)
LIMITS = Limits({"u": InputLimit(0.2)}, {"phi": 0.1})


def simulated(values, u):
    """Return phi of the oscillator k, d, b for a held input, by SciPy's matrix exponential."""
    k, d, b = values
    A, B = np.array([[-d, -k], [1.0, 0.0]]), np.array([[b], [0.0]])
    E = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 3))]]) * DT)
    x, out = np.zeros(2), []
    for v in u:
        out.append(x[1])
        x = E[:2, :2] @ x + E[:2, 2] * v
    return np.array(out)


def covariance_by_differences(u, start_free=True):
    """Return the covariance of log k, d, b from central differences, with a free initial state."""
    theta, columns = np.log([36.0, 2.0, 20.0]), []
    for i in range(3):
        step = 1e-5 * np.eye(3)[i]
        up, down = simulated(np.exp(theta + step), u), simulated(np.exp(theta - step), u)
        columns.append((up - down) / 2e-5)
    A = np.array([[-2.0, -36.0], [1.0, 0.0]])
    free = np.stack([scipy.linalg.expm(A * DT * n)[1] for n in range(len(u))])
    J = np.column_stack([*columns, free]) / SD
    return np.linalg.inv(J.T @ J)[:3, :3]


def problem(u=RANDOM, **changes):
    u = np.asarray(u)
    y = {"phi": simulated([36.0, 2.0, 20.0], u)}
    flight = Flight(DT, {"u": u, "v": np.zeros(u.size)}, y, sd={"phi": SD})
    return Problem(SWING, TRUTH, [flight], FREE, Nuisance(bias=False), **changes)


def test_expected_sd_is_that_of_an_independent_program():
    found = design(problem(), LIMITS, own=[{"u": RANDOM}], max_steps=0)
    assert found.own is not None
    expected = np.sqrt(np.diag(covariance_by_differences(RANDOM)))
    assert list(found.own.sd.values()) == pytest.approx(expected, rel=2e-3)
    powers = np.array([-0.0, 0.0, 1.0]) - np.array([1.0, 0.0, 0.0])
    C = covariance_by_differences(RANDOM)
    assert found.sd_of(found.own, "b/k") == pytest.approx(np.sqrt(powers @ C @ powers), rel=2e-3)
    for rated in found.library:
        expected = np.sqrt(np.diag(covariance_by_differences(rated.inputs[0]["u"])))
        assert list(rated.sd.values()) == pytest.approx(expected, rel=2e-3), rated.words


def test_repeated_flights():
    found = design(problem(), LIMITS, own=[{"u": RANDOM}], max_steps=0)
    once = found.sd_of(found.own, "d")
    assert found.sd_of(found.own, "d", 4.0) == pytest.approx(0.5 * once, rel=1e-3)
    needed = found.needed(found.own, {"d": 0.25 * once})
    assert needed == pytest.approx(16.0 * found.duration, rel=1e-2)


def test_a_prior_is_not_repeated():
    free = {"k": Free(36.0, prior=Prior(36.0, 0.36)), "d": Free(2.0), "b": Free(20.0)}
    # At rest only the prior has information.
    tiny = Limits({"u": InputLimit(1e-9)})
    found = design(dataclasses.replace(problem(), free=free), tiny, max_steps=0)
    best = found.library[0]
    assert best.sd["k"] == pytest.approx(0.01, rel=1e-2)
    assert best.undetermined == ("d", "b")
    assert found.needed(best, {"k": 0.005}) == np.inf


@pytest.mark.parametrize(
    "method", ["output-error", pytest.param("filter-error", marks=pytest.mark.slow)]
)
def test_gradient_against_differences(method):
    of = problem()
    if method == "filter-error":
        model = with_disturbance(SWING, ["p"])
        gusts = {"sigma_w": jnp.asarray(0.3), "tau_w": jnp.asarray(0.5)}
        of = dataclasses.replace(
            of, model=model, vehicle=model.Params(**asdict(TRUTH), **gusts), method=method
        )
    search = _searching(of, LIMITS)
    rng = np.random.default_rng(0)
    x, along = rng.uniform(-0.5, 0.5, search.size), rng.standard_normal(search.size)
    arguments = np.array([0.7]), 10.0
    (value, _), slope = search.augmented(x, *arguments)
    up, down = (search.augmented(x + h * along, *arguments)[0][0] for h in (1e-5, -1e-5))
    assert float(along @ slope) == pytest.approx(float((up - down) / 2e-5), rel=1e-5)
    assert np.isfinite(value)


def _searching(of, limits, criterion="D"):
    from heli_jax.identification.design.information import planned
    from heli_jax.identification.estimation.data import data_of, start_vector
    from heli_jax.identification.estimation.noise_covariance import first_noise
    from heli_jax.identification.unknowns.layout import layout_of

    layout = layout_of(of, of.training)
    data = data_of(of, of.training, layout)
    z = np.asarray(start_vector(layout, data, of))
    experiment = planned(of, layout, data, first_noise(of, of.training), z[None])
    return _Search(experiment, limits, criterion, [{}], {})


@pytest.mark.parametrize("criterion", ["D", pytest.param("E", marks=pytest.mark.slow), "b/k"])
def test_the_optimum_is_better_and_holds_its_limits(criterion):
    limits = Limits({"u": InputLimit(0.2, rate=4.0)}, {"phi": 0.1, "p": 0.8})
    found = design(problem(), limits, criterion=criterion, max_steps=60)
    best, optimum = found.library[0], found.optimum
    assert optimum.value < best.value
    u = optimum.inputs[0]["u"]
    assert np.max(np.abs(u)) <= 0.2 * (1 + 1e-9)
    assert np.max(np.abs(np.diff(u))) <= 4.0 * DT * (1 + 1e-9)
    phi = simulated([36.0, 2.0, 20.0], u)
    assert np.max(np.abs(phi)) <= 0.1
    assert optimum.margins["phi"] == pytest.approx(1.0 - np.max(np.abs(phi)) / 0.1, abs=1e-6)
    C = covariance_by_differences(u)
    value = {
        "D": 0.5 * np.linalg.slogdet(C)[1] / 3,
        "A": 0.5 * np.log(np.trace(C) / 3),
        "E": 0.5 * np.log(np.linalg.eigvalsh(C)[-1]),
        "d": 0.5 * np.log(C[1, 1]),
        "b/k": 0.5 * np.log(C[0, 0] + C[2, 2] - 2 * C[0, 2]),
    }[criterion]
    assert optimum.value == pytest.approx(value, abs=5e-3)


def test_a_known_difference_is_chosen():
    # The output of a second run is scaled by a known factor: larger is better.
    flights = [problem().training[0], dataclasses.replace(problem().training[0], known={"b": 20.0})]
    free = {n: f for n, f in FREE.items() if n != "b"}
    of = dataclasses.replace(problem(), flights=flights[1:], free=free)
    found = design(
        of, Limits({"u": InputLimit(0.2)}), differences=[{"b": (10.0, 40.0)}], max_steps=30
    )
    assert found.optimum.known[0]["b"] == pytest.approx(40.0, rel=1e-6)
    halved = design(
        of, Limits({"u": InputLimit(0.2)}), differences=[{"b": (10.0, 10.1)}], max_steps=0
    )
    assert halved.library[0].sd["k"] > 2.0 * found.optimum.sd["k"]


@pytest.mark.slow
def test_several_vehicles():
    free = {"k": Free(36.0, lower=18.0, upper=72.0), "d": Free(2.0), "b": Free(20.0)}
    of = dataclasses.replace(problem(), free=free)
    found = design(of, LIMITS, vehicles=4, max_steps=0)
    assert found.library[0].covariance.shape == (4, 3, 3)
    alone = design(of, LIMITS, max_steps=0)
    one = {r.words: r for r in alone.library}
    # The worst of the vehicles counts, and the first is the start.
    for rated in found.library:
        if rated.inputs[0]["u"].tolist() == one[rated.words].inputs[0]["u"].tolist():
            assert all(rated.sd[n] >= 0.999 * one[rated.words].sd[n] for n in rated.sd)


def test_feedback_flies_the_excitation():
    def loop(state, inputs):
        return inputs._replace(u=inputs.u - 0.5 * state.phi)

    found = design(problem(), LIMITS, feedback=loop, own=[{"u": RANDOM}], max_steps=0)
    k, d, b = 36.0, 2.0, 20.0
    A, B = np.array([[-d, -k], [1.0, 0.0]]), np.array([[b], [0.0]])
    E = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 3))]]) * DT)
    x, acting = np.zeros(2), []
    for v in RANDOM:
        acting.append(v - 0.5 * x[1])
        x = E[:2, :2] @ x + E[:2, 2] * acting[-1]
    expected = np.sqrt(np.diag(covariance_by_differences(np.array(acting))))
    assert list(found.own.sd.values()) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("text", "powers"),
    [("a/Ixx", [1, -1, 0]), ("1/a", [-1, 0, 0]), ("a*If/Ixx", [1, -1, 1])],
)
def test_products(text, powers):
    assert exponents(text, ("a", "Ixx", "If")).tolist() == powers


@pytest.mark.parametrize(
    "changes",
    [
        {"limits": Limits({"w": InputLimit(1.0)})},
        {"limits": Limits({"u": InputLimit(1.0)}, {"bank": 1.0})},
        {"limits": Limits({"u": InputLimit(0.0)})},
        {"limits": Limits({})},
        {"criterion": "z/k"},
        {"vehicles": 0},
        {"differences": [{"b": (1.0, 2.0)}]},
        {"differences": []},
    ],
)
def test_refused(changes):
    arguments = {"limits": LIMITS, **changes}
    with pytest.raises(ValueError, match=r"expected|has no"):
        design(problem(), **arguments)


def test_files_for_autopilots_and_transmitters():
    lines = dict(
        line.split(",")
        for line in ardupilot_parameters(
            (0.1, 5.0), "rate-roll", np.radians(20), 60, 3
        ).splitlines()
    )
    assert float(lines["SID_AXIS"]) == 7
    assert float(lines["SID_MAGNITUDE"]) == 20
    assert float(lines["SID_T_REC"]) == 60
    assert (float(lines["SID_F_START_HZ"]), float(lines["SID_F_STOP_HZ"])) == (0.1, 5.0)
    assert ARDUPILOT["input-yaw"] == (3, "rad/s")
    commands = betaflight_commands((0.25, 5.0), "yaw", np.radians(20.5), 20.9).splitlines()
    assert "set chirp_amplitude_yaw = 20" in commands
    assert "set chirp_time_seconds = 20" in commands
    script = transmitter_script(0.01, [("lat", np.array([0.0, 0.5, 1.0, -1.0, 2.0]))])
    assert "{0,1024,1024}" in script


CONFIG = """
model: {linear: roll}
fit: {free: {Lb: {start: 166.1}, tau_f: {start: 0.046}, Blat: {start: 0.14}}}
simulate:
  duration: 6
  rate: 50
  inputs: {lat: {kind: doublet, amplitude: 0.1}}
  noise: {p: {sd: 1, unit: deg/s}, phi: {sd: 0.5, unit: deg}}
design:
  criterion: tau_f
  max_steps: 15
  inputs: {lat: {amplitude: 0.1, set_point: p, ardupilot: rate-roll, full_stick: 1}}
  feedback: {lat: {p: 0.05}}
  motion: {phi: {most: 30, unit: deg}}
"""


def test_command(tmp_path, capsys):
    config, out = tmp_path / "design.yaml", tmp_path / "run"
    config.write_text(CONFIG)
    code = main(["design", str(config), "--out", str(out), "--for", "tau_f=1%", "--quiet"])
    content = json.loads((out / "design.json").read_text())
    assert code == (0 if content["converged"] else 4)
    assert content["optimum"]["sd"]["tau_f"] <= content["library"][0]["sd"]["tau_f"]
    assert content["optimum"]["seconds_needed"] > 0
    assert min(content["optimum"]["margins"].values()) > -1e-9
    table = np.genfromtxt(out / "input.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time_s", "lat_rads")
    assert np.max(np.abs(table["lat_rads"])) <= 0.1 * (1 + 1e-9)
    # The file plays a chirp that is rated, and which ArduPilot accepts.
    words = [r["input"] for r in content["library"] if r["input"].startswith("ArduPilot's")]
    assert f"ardupilot-lat.param: {words[0]}" in (printed := capsys.readouterr().out)
    lines = (out / "ardupilot-lat.param").read_text().splitlines()
    played = dict(line.split(",") for line in lines)
    assert float(played["SID_T_REC"]) > 2.0 / float(played["SID_F_START_HZ"])
    assert {"report.html", "config.yaml", "ardupilot-lat.param", "input.lua"} <= {
        p.name for p in out.iterdir()
    }
    assert "tau_f" in printed


@pytest.mark.parametrize(
    "change",
    ["simulate=null", "design=null", "design.inputs.lat.set_point=b", "simulate.noise={}",
     "design.motion.x.most=1", "design.inputs.lat.ardupilot=mixer-roll", "design.criterion=a/b",
     "design.inputs.lat.full_stick=0.05"],
)  # fmt: skip
def test_wrong_configurations(tmp_path, capsys, change):
    config = tmp_path / "design.yaml"
    config.write_text(CONFIG)
    code = main(["design", str(config), "--out", str(tmp_path / "run"), "--set", change])
    assert code == 2
    assert not (tmp_path / "run").exists()
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("model", "files"),
    [
        pytest.param("quad-roll", {"ardupilot-lat.param"}, marks=pytest.mark.slow),
        ("yaw", set()),
    ],
)
def test_from_a_shipped_model_to_files(tmp_path, model, files):
    config, out = tmp_path / "start.yaml", tmp_path / "run"
    assert main(["models", model, "--config", str(config), "--quiet"]) == 0
    few = ["--set", "design.max_steps=0", "--set", "simulate.duration=6"]
    # Not every model has only parameters that one record determines.
    assert main(["design", str(config), "--out", str(out), "--quiet", *few]) in (0, 3)
    assert files <= {p.name for p in out.iterdir()}
    assert main(["models", model, "--config", str(config)]) == 2


def test_wrong_wanted(tmp_path):
    config = tmp_path / "design.yaml"
    config.write_text(CONFIG)
    for text in ("tau_f", "tau_f=x", "=2%", "nothing=2%"):
        assert main(["design", str(config), "--out", str(tmp_path / "o"), "--for", text]) == 2
