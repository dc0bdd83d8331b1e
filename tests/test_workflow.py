"""The whole analysis from Python: equal to the command line, and readable from files."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import heli_jax
from heli_jax.cli import main
from heli_jax.cli.fits import print_check
from heli_jax.errors import InputError
from heli_jax.finding import found
from heli_jax.identification.design.accuracy import starting_at_zero
from heli_jax.identification.problem import Free, Prior

CONFIG = """
model: roll-on-stand
vehicle: {vehicle}
flights:
  - log: bench.csv
    signals:
      time: {{signal: t}}
      inputs: {{x_roll: {{signal: stick, unit: m}}}}
      outputs: {{roll: {{signal: roll, unit: rad, sd: 0.002}}}}
fit:
  free:
    Ixx: {{start: 0.03}}
    If: {{start: 2.0e-4}}
rls: {{order: 4}}
simulate:
  duration: 20.0
  rate: 50.0
  inputs: {{x_roll: {{kind: random-steps, amplitude: 3.0e-6, hold: [0.2, 1.5]}}}}
  noise: {{roll: {{sd: 0.002}}}}
sweep:
  design: grid
  axes: {{Ixx: {{lower: 0.02, upper: 0.03, n: 3}}}}
  reduce: {{misfit: {{how: nrmse, signal: roll}}}}
"""
VEHICLE = Path(__file__).parents[1] / "configs/vehicles/bench-30.yaml"


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workflow")
    path = folder / "bench.yaml"
    path.write_text(CONFIG.format(vehicle=VEHICLE))
    assert main(["simulate", str(path), "--out", str(folder / "bench.csv")]) == 0
    return path


@pytest.fixture(scope="module")
def run(config):
    said = []
    done = heli_jax.run_fit(config, config.parent / "fit", progress=said.append)
    assert said[-1] == "writing the report"
    return done


def test_a_fit_from_python_is_that_of_the_command_line(config, run, tmp_path):
    out = tmp_path / "cli"
    assert main(["fit", str(config), "--out", str(out)]) == 0
    ours, theirs = (json.loads((d / "fit.json").read_text()) for d in (run.directory, out))
    assert ours.pop("timing_s").keys() == theirs.pop("timing_s").keys()
    assert ours == theirs
    names = {p.name for p in run.directory.iterdir()}
    assert names == {"config.yaml", "fit.json", "signals.csv", "report.html", "figures"}


def test_a_saved_fit_is_read_back(run):
    saved = heli_jax.load_fit(run.directory)
    assert saved.estimates == run.fit.estimates
    assert saved.nuisance.keys() == run.fit.nuisance.keys()
    assert (saved.status, saved.verdict) == (run.fit.status, run.fit.verdict.text)
    assert saved.adequate == run.fit.adequate
    assert saved.metrics["roll"] == run.fit.metrics["roll"]
    assert saved.notes == run.fit.notes
    [mine], [theirs] = run.fit.signals, saved.signals
    for part in ("inputs", "measured", "simulated"):
        assert getattr(mine, part).keys() == getattr(theirs, part).keys()
    np.testing.assert_array_equal(mine.residual("roll"), theirs.residual("roll"))
    lower, upper = saved.intervals["Ixx"]["gaussian"]
    assert lower < saved.estimates["Ixx"].value < upper
    assert saved.to_dataframe().equals(run.fit.to_dataframe())
    assert str(run.directory) in repr(saved)
    assert "kg m^2" in repr(saved)


def test_a_directory_without_a_fit_is_refused_in_a_sentence(tmp_path):
    with pytest.raises(InputError, match=r"fit\.json"):
        heli_jax.load_fit(tmp_path)
    for text in ("[]", "{", '{"status": "converged"}', '{"parameters": 1}'):
        (tmp_path / "fit.json").write_text(text)
        (tmp_path / "signals.csv").write_text("t\n")
        with pytest.raises(InputError, match=r"fit\.json"):
            heli_jax.load_fit(tmp_path)


def test_overrides_are_a_mapping_or_the_command_lines_texts(config):
    by_key = heli_jax.load_config(config, {"fit.free.Ixx.start": 0.04, "flights.0.rate": 25})
    by_text = heli_jax.load_config(config, ["fit.free.Ixx.start=0.04", "flights.0.rate=25"])
    assert by_key.config == by_text.config
    assert by_key.config.fit.free["Ixx"].start == 0.04
    with pytest.raises(InputError, match=r"flights\.0\.rate\.x"):
        heli_jax.load_config(config, {"flights.0.rate.x": 1, "flights.0.rate.x.y": 2})


def test_nothing_is_written_over(run):
    before = (run.directory / "fit.json").read_bytes()
    for number in (2, 3):
        with pytest.warns(UserWarning, match="exists"):
            written = heli_jax.write_report(run, run.directory)
        assert written.directory == run.directory.with_name(f"{run.directory.name}-{number}")
        assert (written.directory / "report.html").exists()
    assert (run.directory / "fit.json").read_bytes() == before


def test_a_figure_of_the_report_is_drawn(run):
    assert run.figure("response_roll").axes[0].get_ylabel().startswith("roll")
    with pytest.raises(ValueError, match=r"expected one of .*response_roll.*got 'roll'"):
        run.figure("roll")


def test_check_and_further_intervals(config, run):
    check = heli_jax.run_check(config)
    assert check.verdict.identifiable
    more = heli_jax.intervals(run.fit, profiles=["Ixx"])
    assert set(more.by_parameter["Ixx"]) == {"gaussian", "profile"}


def test_an_interrupt_of_the_intervals_keeps_the_fit(config, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    asked = heli_jax.load_config(config, {"fit.intervals.profile": ["Ixx"]})
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr("heli_jax.workflow.intervals", interrupted)
        with pytest.raises(KeyboardInterrupt):
            heli_jax.run_fit(asked, out)
    content = json.loads((out / "fit.json").read_text())
    assert "uncertainty.interrupted" in [f["code"] for f in content["findings"]]
    assert all(e.sd > 0 for e in heli_jax.load_fit(out).estimates.values())
    whole = heli_jax.run_fit(asked, tmp_path / "again")
    content = json.loads((tmp_path / "again" / "fit.json").read_text())
    assert "uncertainty.interrupted" not in [f["code"] for f in content["findings"]]
    assert whole.supplementary.intervals is not None
    assert (tmp_path / "again" / "report.html").exists()


def test_a_sweep_in_memory_and_in_a_directory(config, tmp_path):
    in_memory = heli_jax.run_sweep(config)
    stored = heli_jax.run_sweep(config, tmp_path / "sweep", figures=False)
    np.testing.assert_array_equal(in_memory["misfit"], stored["misfit"])
    assert in_memory.sizes["element"] == 3
    assert (tmp_path / "sweep" / "config.yaml").exists()
    assert not (tmp_path / "sweep" / "figures").exists()


def test_a_unit_that_nobody_stated_is_told(config, run, tmp_path):
    folder = config.parent
    text = config.read_text().replace("{signal: stick, unit: m}", "{signal: stick}")
    text = text.replace("{signal: roll, unit: rad, sd", "{signal: roll, sd")
    path = folder / "no-units.yaml"
    path.write_text(text)
    assert main(["fit", str(path), "--out", str(tmp_path / "fit")]) == 0
    saved = heli_jax.load_fit(tmp_path / "fit")
    notes = [(n["code"], n["subjects"]) for n in saved.content["data"][0]["notes"]]
    assert notes == [("units.assumed", ["x_roll"]), ("units.assumed", ["roll"])]
    assert run.problem.flights[0].source.notes == ()
    assert run.fit.estimates == saved.estimates


def test_what_check_refuses_is_not_fitted(config, tmp_path):
    """Test that a log at half a hertz is refused for a roll that swings at a third of a hertz."""
    rows = (config.parent / "bench.csv").read_text().splitlines()
    (tmp_path / "bench.csv").write_text("\n".join([rows[0], *rows[1::100]]) + "\n")
    path = tmp_path / "slow.yaml"
    path.write_text(config.read_text().replace("unit: m}", "unit: m, hold: linear}"))
    assert main(["fit", str(path), "--out", str(tmp_path / "fit")]) == 2
    assert not (tmp_path / "fit").exists()


def test_a_check_for_other_programs(config, capsys):
    assert main(["check", str(config), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    check = heli_jax.run_check(config)
    assert (found["identifiable"], found["refused"]) == (True, False)
    assert [(f["code"], f["value"]) for f in found["findings"]] == [
        (f.code, f.value) for f in check.findings
    ]
    sd = found["expected_relative_sd"]
    np.testing.assert_allclose(list(sd.values()), np.sqrt(np.diag(check.verdict.covariance)))
    assert list(sd) == ["Ixx", "If"]
    assert found["noise_sd"] == {"flight 1/roll": 0.002}


def test_of_a_start_at_zero_no_part_is_expected(config, capsys):
    roll, t = heli_jax.linear_model("roll-flybarless"), np.arange(0.0, 4.0, 0.02)
    flight = heli_jax.Flight(dt=0.02, inputs={"lat": np.sin(t)}, outputs={"p": np.cos(t)})
    free = {"Blat": Free(0.1), "Lb": Free(0.0, prior=Prior(0.0, 50.0))}
    problem = heli_jax.Problem(roll.model, roll.vehicle().params, [flight], free)
    assert starting_at_zero(problem) == {"Lb": (50.0, "1/s^2")}
    check = dataclasses.replace(heli_jax.run_check(config), at_zero={"If": (0.5, "kg m^2")})
    print_check(check)
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert rows["Ixx"].count("%") == 2
    assert rows["If"].count("%") == 1
    sd = 0.5 * float(np.sqrt(check.verdict.covariance[1, 1]))
    assert f"{sd:.1e} kg m^2" in rows["If"]
    # Without sensor noise nothing is known of the expected sd; the prior's share remains.
    smoothed = (*check.findings, found("noise.smoothed", "doubt", "roll"))
    print_check(dataclasses.replace(check, findings=smoothed))
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert [rows[n].count("%") for n in ("Ixx", "If")] == [1, 1]
    assert "kg m^2" not in rows["If"]


def test_the_time_of_a_run_is_told_part_by_part(config):
    """Test that all long stages are named."""
    asked = {"fit.intervals": {"profile": ["Ixx"]}}
    out = config.parent / "told"
    heli_jax.run_fit(heli_jax.load_config(config, asked), out)
    seconds = json.loads((out / "fit.json").read_text())["timing_s"]
    assert seconds["profile likelihood"] > 0
    total = seconds.pop("total")
    del seconds["compilation (of these)"]
    assert sum(seconds.values()) == pytest.approx(total, rel=0.03)
