"""Studies of fits: combinations, kills and resuming, failures, and the Dataset."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

from heli_jax import cli, load_fit, run_study
from heli_jax.config.study import read_study
from heli_jax.errors import InputError
from heli_jax.studies import run as studies
from heli_jax.studies.point import Outcome, fit_point
from heli_jax.studies.worker import read_outcome, write_outcome

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    """Write a bench with a record by hand: I phi'' = -k phi + stick, in small steps."""
    folder = tmp_path_factory.mktemp("study")
    t = 0.05 * np.arange(400)
    stick = 3e-6 * np.sign(np.sin(0.9 * t + 0.02 * t**2))
    rows = np.column_stack([t, stick, np.zeros_like(t)])
    content = {
        "model": "roll-on-stand",
        "vehicle": str(ROOT / "configs" / "vehicles" / "bench-30.yaml"),
        "flights": [
            {
                "log": "a.csv",
                "signals": {
                    "time": {"signal": "t"},
                    "inputs": {"x_roll": {"signal": "stick", "unit": "m"}},
                    "outputs": {"roll": {"signal": "roll", "unit": "rad", "sd": 0.002}},
                },
            }
        ],
        "fit": {"free": {"Ixx": {"start": 0.03}, "If": {"start": 2e-4}}},
        "rls": None,
        "simulate": {
            "duration": 20.0,
            "rate": 20.0,
            "inputs": {"x_roll": {"kind": "random-steps", "amplitude": 3e-6, "hold": [0.2, 1.5]}},
            "noise": {"roll": {"sd": 0.002}},
        },
    }
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    assert cli.main(["simulate", str(path), "--out", str(folder / "a.csv")]) == 0
    np.savetxt(folder / "short.csv", rows[:3], "%g", ",", header="t,stick,roll", comments="")
    return path


def here(tasks, options):
    """Run in this process, since starting others takes seconds."""
    for k, task in enumerate(tasks):
        # A worker receives it through JSON.
        yield k, fit_point(type(task)(**json.loads(json.dumps(task._asdict()))))


class Killed(BaseException):
    pass


def test_interrupted_and_resumed_it_is_the_same_dataset(config, tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "_outcomes", here)
    arguments = ["fit", str(config), "--set", "flights.0.log=[a.csv, short.csv]"]
    arguments += ["--over", "fit.free.Ixx.start=0.02,0.04"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert cli.main([*arguments, "--out", str(whole)]) == 4

    over = {"fit.free.Ixx.start": [0.02, 0.04]}
    overrides = {"flights.0.log": ["a.csv", "short.csv"]}

    def kill(done, _):
        if done == 2:
            assert len(list(killed.glob("fits/[!.]*/fit.json"))) == 2
            raise Killed

    with pytest.raises(Killed):
        run_study(config, killed, over, overrides, progress=kill)
    (killed / "fits" / ".2_log=short-0123abcd").mkdir()  # unfinished output
    done = next((killed / "fits").glob("0_*/fit.json"))
    before = done.stat().st_ino
    found = run_study(config, killed, over, overrides, resume=True)
    stored = [xr.open_zarr(d / "study.zarr", consolidated=False) for d in (whole, killed)]
    assert stored[0].identical(stored[1])
    assert found.load().identical(stored[1].load())
    assert done.stat().st_ino == before
    assert not list((killed / "fits").glob(".*"))

    assert found.sizes == {
        "flights.0.log": 2, "fit.free.Ixx.start": 2, "parameter": 2, "output": 1
    }  # fmt: skip
    one = found.sel({"flights.0.log": "a.csv", "fit.free.Ixx.start": 0.04})
    saved = load_fit(killed / str(one["run"].item()))
    for name, estimate in saved.estimates.items():
        at = one.sel(parameter=name)
        assert at["estimate"].item() == estimate.value
        assert (at["low"].item(), at["high"].item()) == (estimate.lower95, estimate.upper95)
    assert one["vaf"].item() == saved.metrics["roll"].vaf
    assert saved.content["starts"][0]["converged"]
    # Two starts have one optimum: the vehicle file's truth, within the effect of noise.
    np.testing.assert_allclose(one["estimate"].sel(parameter="Ixx"), 0.024, rtol=0.02)
    lost = found.sel({"flights.0.log": "short.csv"})
    assert set(lost["status"].values.ravel()) == {"failed"}
    assert np.isnan(lost["estimate"]).all()
    assert cli.main(["runs", str(killed)]) == 0
    with pytest.raises(InputError, match=r"another study: axes\.fit\.free\.Ixx\.start was"):
        run_study(config, killed, {"fit.free.Ixx.start": [1.0]}, overrides, resume=True)
    with pytest.raises(InputError, match="exists already"):
        run_study(config, killed, over, overrides)


def test_a_study_of_which_no_fit_could_be_made_says_so(config, tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "_outcomes", here)
    arguments = ["fit", str(config), "--set", "flights.0.log=short.csv"]
    arguments += ["--over", "fit.seed=1,2", "--out", str(tmp_path / "none")]
    assert cli.main(arguments) == 4
    found = xr.open_zarr(tmp_path / "none" / "study.zarr", consolidated=False)
    assert found.sizes == {"fit.seed": 2, "parameter": 0, "output": 0}
    assert cli.main([*arguments, "--resume"]) == 4


def test_values_with_commas_stay_one_value(config):
    study = read_study(
        config,
        ["flights.0.window=[0, 10]", "flights.0.name=a, b"],
        ["fit.seed=1,2", "flights.0.rate=10,20", "fit.intervals.profile=[], [Ixx]"],
    )
    assert study is not None
    assert study.axes == {
        "fit.seed": (1, 2), "flights.0.rate": (10, 20), "fit.intervals.profile": ([], ["Ixx"]),
    }  # fmt: skip
    flight = study.content["flights"][0]
    assert (flight["window"], flight["name"]) == ([0, 10], "a, b")
    assert study.points()[1] == {
        "fit.seed": 1, "flights.0.rate": 10, "fit.intervals.profile": ["Ixx"],
    }  # fmt: skip
    assert read_study(config, ["flights.0.window=[0, 10]"]) is None
    # A value in place of the file's axis gives one fit; a pattern lists all its files.
    in_file = {"flights.0.log": ["*.csv"]}
    assert read_study(config, in_file).axes == {"flights.0.log": ("a.csv", "short.csv")}


@pytest.mark.parametrize(
    "options",
    [
        ["--over", "fit.seed=1"],
        ["--over", "fit.seed=1,1"],
        ["--over", "fit.seed=1,x"],
        ["--set", "flights.0.log=[none-*.csv]"],
        ["--set", f"flights.0.log=[a{'*' * 5000}.csv]"],
        ["--set", "study.fit.seed=[1, 2]"],
        ["--workers", "2"],
        ["--over", "fit.seed=1,2", "--resume"],
    ],
)
def test_what_is_wrong_ends_in_one_sentence(options, config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["fit", str(config), *options]) == 2
    shown = capsys.readouterr().err.strip()
    assert len(shown.splitlines()) == 1
    assert not list(tmp_path.iterdir())
    assert cli.main(["check", str(config), "--set", "fit.seed=1", "--set", "fit.seed=2"]) == 2


def test_a_page_names_the_studys_command_and_its_point(config, tmp_path, monkeypatch):
    """Test that the command is the user's, not the worker's."""
    asked = "heli-jax fit bench.yaml --over fit.free.Ixx.start=0.02,0.03"
    monkeypatch.setattr("sys.argv", asked.split())
    study = read_study(config, (), ["fit.free.Ixx.start=0.02,0.03"])
    assert study is not None
    task = studies._tasks(study, reports=True)[1]
    monkeypatch.setattr("sys.argv", ["/opt/heli_jax/studies/worker.py"])
    page = fit_point(task).files["report.html"].decode()
    assert f">{asked}</pre>" in page
    assert "fit.free.Ixx.start = 0.03<" in page
    assert "worker.py" not in page


def test_an_answer_that_is_cut_off_is_none():
    stream = io.BytesIO()
    files = {"fit.json": b"{}\n", "figures/a.png": bytes(range(256))}
    outcome = Outcome(files, None, ("bench.csv: ten rows were left out",))
    write_outcome(stream, outcome)
    whole = stream.getvalue()
    assert read_outcome(io.BytesIO(whole)) == outcome
    for cut in (0, 5, len(whole) - 1):
        assert read_outcome(io.BytesIO(whole[:cut])) is None
