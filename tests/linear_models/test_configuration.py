"""`model: {linear: FILE}` in a configuration."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import config as configuration
from heli_jax.cli import main
from heli_jax.errors import InputError
from heli_jax.linear_models.read import linear_model
from heli_jax.sweep_workflow import run_sweep

FILES = Path(__file__).parents[2] / "heli_jax" / "linear_models" / "files"
HEAVE = {
    "model": {"linear": "heave"},
    "flights": [
        {
            "log": "heave.csv",
            "signals": {
                "time": {"signal": "t"},
                "inputs": {"col": {"signal": "stick", "unit": "%"}},
                "outputs": {"w": {"signal": "w", "unit": "ft/s", "sd": 0.05}},
            },
        }
    ],
    "fit": {"free": {"Zw": {"start": -1.0}, "Zcol": {"start": -10.0}}},
    "simulate": {
        "duration": 20,
        "rate": 10,
        "inputs": {"col": {"amplitude": 10, "unit": "%"}},
        "noise": {"w": {"sd": 0.05, "unit": "ft/s"}},
    },
}


@pytest.fixture
def written(tmp_path):
    """Return written(key=value, ...), the path of a configuration of heave with these keys."""

    def written(**content):
        path = tmp_path / "heave.yaml"
        path.write_text(yaml.safe_dump({**HEAVE, **content}, sort_keys=False))
        return path

    return written


def test_its_own_values_are_the_vehicle(written):
    found = configuration.load(written())
    assert found.model is linear_model("heave").model
    assert found.vehicle.constants["Zw"].source == "CMU-RI-TR-00-03"
    np.testing.assert_allclose(found.vehicle.params.Zcol, -45.84 * 0.3048)


def test_a_vehicle_replaces_values_by_name(written, tmp_path):
    entry = {"Zw": {"value": -60.0, "unit": "1/min", "source": "mine"}}
    (tmp_path / "vehicle.yaml").write_text(yaml.safe_dump(entry))
    for vehicle in (entry, "vehicle.yaml"):
        found = configuration.load(written(vehicle=vehicle)).vehicle
        np.testing.assert_allclose((found.params.Zw, found.params.Zcol), (-1.0, -13.972032))
        assert found.constants["Zw"].source == "mine"


def test_a_file_beside_the_configuration_runs_again_from_anywhere(written, tmp_path):
    shutil.copy(FILES / "heave.yaml", tmp_path / "mine.yaml")
    found = configuration.load(written(model={"linear": "mine.yaml"}))
    assert found.model is linear_model("heave").model
    again = tmp_path / "elsewhere" / "config.yaml"
    again.parent.mkdir()
    again.write_text(yaml.safe_dump(configuration.resolved(found)))
    assert configuration.load(again).model is found.model
    assert configuration.load(again).vehicle.params == found.vehicle.params


def test_an_element_whose_time_constant_is_no_time_is_out_of_range(written):
    sweep = {
        "design": "grid",
        "inputs": "simulate",
        "axes": {"tau_nu": {"values": [-0.1, 0.0, 0.1]}},
        "reduce": {"peak": {"signal": "w", "how": "peak"}},
    }
    signals = {**HEAVE["flights"][0], "log": "none.csv"}
    path = written(model={"linear": "heave-inflow"}, flights=[signals], fit=None, sweep=sweep)
    found = run_sweep(path)
    assert np.isnan(found["peak"].values[:2]).all()
    assert np.isfinite(found["peak"].values[2])


@pytest.mark.parametrize(
    "content",
    [
        {"model": {"linear": "heav"}},
        {"model": {"linear": "no.yaml"}},
        {"model": {"liner": "heave"}},
        {"model": {"linear": 5}},
        {"model": 5},
        {"model": "roll"},
        {"vehicle": {"Zv": 1}},
        {"corrections": {"tail": True}},
        {"vehicle": {"Zw": "x"}},
    ],
)
def test_what_cannot_be_ends_in_a_sentence(written, content):
    path = written(**content)
    with pytest.raises(InputError) as e:
        configuration.load(path)
    # The message has the file and the key.
    assert str(e.value).startswith(f"{path}: {next(iter(content))}") or content["model"] == "roll"


def test_the_log_of_a_model_with_a_delay_holds_what_was_commanded(written, tmp_path):
    """Test that a log has commanded inputs; with delayed ones a fit would find no delay."""
    content = yaml.safe_load((FILES / "heave.yaml").read_text())
    content["parameters"]["tau"] = {"value": 0.13, "unit": "s"}
    content["delays"] = {"col": "tau"}
    (tmp_path / "late.yaml").write_text(yaml.safe_dump(content))
    steps = {"kind": "3-2-1-1", "amplitude": 10, "unit": "%", "step": 1.0, "pause": 2.0}
    simulate = {**HEAVE["simulate"], "duration": 4, "inputs": {"col": steps}}
    path = written(model={"linear": "late.yaml"}, simulate=simulate)
    assert main(["simulate", str(path), "--out", str(tmp_path / "heave.csv")]) == 0
    time, stick, w = np.loadtxt(tmp_path / "heave.csv", delimiter=",", skiprows=1).T
    moved = np.argmax(stick != 0)
    np.testing.assert_allclose(time[moved], 2.0)
    # The motion starts 0.13 s later, first visible in the second sample after that of 0.1 s.
    assert abs(w[moved + 1]) < 0.3 < abs(w[moved + 3])
