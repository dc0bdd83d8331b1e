"""`model: {linear: FILE}` in a configuration."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

from heli_jax import config as configuration
from heli_jax import fit, generate
from heli_jax.cli import main
from heli_jax.errors import InputError
from heli_jax.linear_models.read import linear_model
from heli_jax.sweep_workflow import run_sweep
from heli_jax.workflow import run_check

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
    """written(key=value, ...) -> the path of a configuration of heave with these keys."""

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


@pytest.mark.slow
def test_it_is_simulated_checked_and_swept(written, tmp_path):
    path = written()
    assert main(["simulate", str(path), "--out", str(tmp_path / "heave.csv")]) == 0
    assert run_check(path).verdict.undetermined == ()
    sweep = {
        "design": "grid",
        "inputs": "simulate",
        "axes": {"Zw": {"values": [-1.0, -0.5]}},
        "reduce": {"peak": {"signal": "w", "how": "peak"}},
    }
    peaks = run_sweep(written(sweep=sweep))["peak"].values
    # Less damping, more speed for the same collective.
    assert 0 < peaks[0] < peaks[1]


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


def test_heave_can_be_disturbed(written):
    found = configuration.load(written(disturbance={"axis": "heave", "sigma_w": 0.5, "tau_w": 1.0}))
    quiet = generate.generate(configuration.load(written())).runs["heave"]
    moved = generate.generate(found).runs["heave"]
    assert np.std(np.asarray(moved.outputs.w) - np.asarray(quiet.outputs.w)) > 0.1


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"model": {"linear": "heav"}}, ["model.linear", "'heav'", "did you mean 'heave'"]),
        ({"model": {"linear": "no.yaml"}}, ["model.linear", "no.yaml: no such file"]),
        ({"model": {"liner": "heave"}}, ["model: unknown key 'liner'", "did you mean 'linear'"]),
        ({"model": {"linear": 5}}, ["model: linear: expected the name of a file, got 5"]),
        ({"model": 5}, ["model: expected a model's name or {linear: FILE}, got 5"]),
        ({"model": "roll"}, ["vehicle: missing"]),
        ({"vehicle": {"Zv": 1}}, ["vehicle: unknown constant 'Zv'"]),
        ({"corrections": {"tail": True}}, ["corrections: a linear model takes none"]),
        ({"vehicle": {"Zw": "x"}}, ["vehicle: Zw"]),
    ],
)
def test_what_cannot_be_ends_in_a_sentence(written, content, words):
    path = written(**content)
    with pytest.raises(InputError) as e:
        configuration.load(path)
    assert str(e.value).startswith(str(path))
    for word in words:
        assert word in str(e.value)


@pytest.mark.parametrize("command", ["simulate", pytest.param("sweep", marks=pytest.mark.slow)])
def test_a_model_with_a_delay_flies(written, tmp_path, capsys, command):
    sweep = {
        "design": "list",
        "inputs": "simulate",
        "axes": {"tau_ped": {"values": [0.0, 0.0991]}},
        "reduce": {"peak": {"signal": "r", "how": "peak"}},
    }
    simulate = {"duration": 2, "rate": 10, "inputs": {"ped": {"amplitude": 0.1}}}
    path = written(model={"linear": "r50-hover"}, flights=[], fit=None, sweep=sweep)
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "simulate": simulate}))
    assert main([command, str(path), "--out", str(tmp_path / "out.csv")]) == 0
    if command == "sweep":
        store = xr.open_zarr(tmp_path / "out.csv/sweep.zarr", consolidated=False, chunks=None)
        assert len(set(np.asarray(store.peak))) == 2  # the delay is a parameter like any other


def test_the_log_of_a_model_with_a_delay_gives_the_delay_back(written, tmp_path):
    """The log holds what was commanded: a log of delayed inputs would be fitted with no delay."""
    content = yaml.safe_load((FILES / "heave.yaml").read_text())
    content["parameters"]["tau"] = {"value": 0.13, "unit": "s"}
    content["delays"] = {"col": "tau"}
    (tmp_path / "late.yaml").write_text(yaml.safe_dump(content))
    steps = {"kind": "3-2-1-1", "amplitude": 10, "unit": "%", "step": 1.0, "pause": 2.0}
    simulate = {**HEAVE["simulate"], "inputs": {"col": steps}}
    free = {**HEAVE["fit"]["free"], "tau": {"start": 0.3}}
    path = written(model={"linear": "late.yaml"}, simulate=simulate, fit={"free": free})
    assert main(["simulate", str(path), "--out", str(tmp_path / "heave.csv")]) == 0
    time, stick, _ = np.loadtxt(tmp_path / "heave.csv", delimiter=",", skiprows=1).T
    np.testing.assert_allclose(time[np.argmax(stick != 0)], 2.0)
    estimates = fit(configuration.problem(configuration.load(path))).estimates
    for name, truth in {"tau": 0.13, "Zw": -0.6141, "Zcol": -45.84 * 0.3048}.items():
        estimate = estimates[name]
        assert estimate.sd is not None
        assert abs(estimate.value - truth) < 3 * estimate.sd < 0.1 * abs(truth)
