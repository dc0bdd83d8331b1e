"""Simulated flights of the whole helicopter: trimmed start, wind, pilot, ground, limits."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import config as configuration
from heli_jax import generate, models
from heli_jax.cli import main
from heli_jax.errors import InputError

ROOT = Path(__file__).parents[1]
XCELL = str(ROOT / "configs" / "vehicles" / "x-cell-60.yaml")


@pytest.fixture
def made(tmp_path):
    """Return made(key=value, ...), the table of two seconds with these keys in `simulate`."""

    def made(model="helicopter-consistent", disturbance=None, **simulate):
        path = tmp_path / "xcell.yaml"
        content = {
            "model": model,
            "vehicle": XCELL,
            "simulate": {"duration": 2, "rate": 50, **simulate},
        }
        if disturbance:
            content["disturbance"] = disturbance
        path.write_text(yaml.safe_dump(content))
        return generate.generate(configuration.load(path))

    return made


@pytest.mark.slow
def test_start_wind_pilot_and_ground(made):
    found = made(
        start={"forward_speed": 4.0, "climb": -1.0, "heading": 0.5},
        wind=[2.0, 0.0, 0.0],
        hold_attitude=True,
        ground=-1.0,
        noise={"roll": {"sd": 2, "unit": "mrad"}},
    )
    # A trimmed descent at 1 m/s is at -1 m after one second, where a row may exist.
    (ended,) = found.notes
    assert (ended.code, ended.value) == ("simulation.ends-on-ground", pytest.approx(1.0, abs=1e-3))
    c = found.columns
    assert c["time"].size in (50, 51)
    assert set(c) >= {"x_throttle", "rotor_speed", "dz"}
    assert not any("wind" in name for name in c)
    np.testing.assert_allclose(c["dx"], 4.0 * np.cos(0.5), atol=1e-6)
    np.testing.assert_allclose(c["dy"], 4.0 * np.sin(0.5), atol=1e-6)
    np.testing.assert_allclose(c["z"], -c["time"], atol=1e-6)
    assert 1e-3 < np.std(c["roll"]) < 3e-3
    [run] = found.runs.values()
    assert np.all(run.inputs.wind_x == 2.0)
    assert run.times.size == c["time"].size == run.states.z.size


@pytest.mark.slow
def test_what_leaves_the_range_is_told(made):
    found = made(
        inputs={
            "x_throttle": {"kind": "chirp", "amplitude": 0.8, "band": [0.2, 0.4]},
            "x_pitch": {"kind": "3-2-1-1", "amplitude": 0.004, "step": 0.5, "pause": 0.1},
        },
        disturbance={"axis": "roll", "sigma_w": 0.1, "tau_w": 1.0},
    )
    said = {(n.code, n.subjects) for n in found.notes}
    assert "simulation.outside-model" in {code for code, _ in said}
    assert ("simulation.stick-beyond-ends", ("x_throttle",)) in said
    assert np.ptp(found.columns["roll"]) > 1e-5


@pytest.mark.parametrize(
    "simulate",
    [
        {"start": {"climb": 50}},
        {"inputs": {"x_rol": {"amplitude": 1}}},
        {"noise": {"rol": {"sd": 1}}},
        # Only of the whole helicopter:
        {"model": "roll", "start": {}},
        {"model": "roll", "wind": [0, 0, 0]},
        {"model": "roll", "hold_attitude": True},
        {"model": "roll", "ground": -1.0},
    ],
)
def test_what_cannot_be_flown(made, simulate):
    with pytest.raises(InputError):
        made(**simulate)


def test_a_pilot_cannot_fly_a_late_stick(made, monkeypatch):
    late = dataclasses.replace(models.helicopter("consistent"), delays=(("x_roll", "Ixx"),))
    load = configuration.load
    monkeypatch.setattr(configuration, "load", lambda p: load(p)._replace(model=late))
    with pytest.raises(InputError, match=r"hold_attitude: .* without delays .* got one of x_roll"):
        made(hold_attitude=True)


def test_a_vehicle_without_what_the_model_needs(tmp_path):
    path = tmp_path / "bench.yaml"
    bench = str(ROOT / "configs" / "vehicles" / "bench-30.yaml")
    content = {
        "model": "helicopter-consistent",
        "vehicle": bench,
        "simulate": {"duration": 1, "rate": 50},
    }
    path.write_text(yaml.safe_dump(content))
    # The error names the vehicle file, since the configuration is right.
    with pytest.raises(InputError, match=r"^\S*/bench-30.yaml: m, .* missing, "):
        generate.generate(configuration.load(path))


def test_a_shipped_manoeuvre_from_the_command_line(tmp_path):
    out = tmp_path / "roll.csv"
    config = ROOT / "configs" / "xcell-roll.yaml"
    assert main(["simulate", str(config), "--out", str(out)]) == 0
    head, *rows = out.read_text().splitlines()
    names = head.replace('"', "").split(",")
    sticks = ["stick_roll", "stick_pitch", "stick_yaw", "collective", "throttle"]
    assert names[:7] == ["t", *sticks, "phi"]
    numbers = np.array([[float(v) for v in row.split(",")] for row in rows])
    table = dict(zip(names, numbers.T, strict=True))
    # The stick moves about the value that holds the rotor against the tail's pull.
    added = table["stick_roll"] - table["stick_roll"][0]
    assert set(np.round(added, 9)) == {-0.5, 0.0, 0.5}
    assert table["stick_roll"][0] < 0
    # The governor keeps the full speed; the collective is that of hover.
    np.testing.assert_allclose(table["throttle"], 100.0, atol=1e-4)
    np.testing.assert_allclose(table["collective"], 49.9596, atol=1e-3)
    # The rate is the angle's derivative; both have their noise.
    slope = np.gradient(table["phi"], table["t"])
    assert np.corrcoef(slope, table["p"])[0, 1] > 0.9
    assert 5 < np.ptp(table["phi"]) < 60
