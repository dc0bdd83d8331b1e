"""Comparison of runs: numbers by hand, escaped text, and the commands."""

import csv
import io
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from heli_jax import cli, compare_runs, load_fit
from heli_jax.errors import InputError
from heli_jax.identification.result import Estimate

METRICS = dict.fromkeys(
    ("vaf", "nrmse_fit_percent", "rmse", "tic", "bias", "variance", "covariance"), 0.5
)


def write_run(
    folder: Path, estimates: dict[str, tuple[float, float | None]], **more: object
) -> Path:
    """Write a run directory for `load_fit`, with invented numbers."""
    folder.mkdir(parents=True)
    parameters = {}
    for name, (value, sd) in estimates.items():
        ends = (None, None) if sd is None else (value - 1.96 * sd, value + 1.96 * sd)
        made = Estimate(value, sd, *ends, "kg m^2", 1.0, 0.0, at_bound=False, sd_white=sd)
        parameters[name] = made._asdict()
    content = {
        "model": "roll",
        "method": "output-error",
        "status": "converged",
        "verdict": {"text": "The data determine all."},
        "identifiable": True,
        "adequate": True,
        "parameters": parameters,
        "nuisance": {},
        "intervals": None,
        "metrics": {"p": METRICS},
        "validation": {},
        "findings": [],
        "data": [{"flight": "flight 1", "hold_out": False, "sha256": folder.name[:1]}],
    } | more
    (folder / "fit.json").write_text(json.dumps(content))
    t = np.arange(20) * 0.1
    rows = ["flight,time,lat,p_measured,p_simulated"]
    rows += [f"flight 1,{x:g},{np.sin(x):g},{np.cos(x):g},{np.cos(x) + 0.1:g}" for x in t]
    (folder / "signals.csv").write_text("\n".join(rows) + "\n")
    return folder


def test_differences_are_in_the_joint_sd(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", {"Ixx": (0.020, 0.003), "If": (2e-4, 1e-5), "a": (5.0, None)})
    b = write_run(tmp_path / "b", {"Ixx": (0.025, 0.004), "K_1": (1.0, 0.1), "a": (5.0, 0.5)})
    compared = compare_runs([a, b])
    rows = {row[0]: row[1:] for row in compared.estimates.rows}
    # 0.005 over hypot(0.003, 0.004)
    assert rows["Ixx"] == ("0.0200 ± 0.0030", "0.0250 ± 0.0040", "+1.0", "kg m²")
    assert rows["If"][1:3] == ("–", "–")
    assert rows["a"][0] == "not determined"
    assert rows["a"][2] == "–"
    read = list(csv.DictReader(io.StringIO(compared.to_csv())))
    undetermined = next(r for r in read if r["run"] == "a" and r["parameter"] == "a")
    assert (undetermined["value"], undetermined["sd"]) == ("", "")
    frame = compared.to_dataframe().set_index(["run", "parameter"])
    assert math.isnan(frame.loc[("a", "a"), "value"])
    assert frame.loc[("b", "Ixx"), "sd"] == 0.004


def test_what_did_not_converge_is_not_compared_and_one_log_is_said(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a1", {"Ixx": (0.02, 0.001)})
    b = write_run(tmp_path / "a2", {"Ixx": (0.03, 0.001)}, status="not-converged")
    compared = compare_runs([a, b])
    assert compared.estimates.rows[0][3] == "–"
    said = [(n.code, n.subjects) for n in compared.notes]
    assert ("compared.not-converged", ("a2",)) in said


def test_fits_of_the_same_samples_are_compared_by_aic(tmp_path: Path) -> None:
    def of(name: str, aic: float, **more: object) -> Path:
        return write_run(tmp_path / name, {"Ixx": (0.02, 0.001)}, aic=aic, n_samples=20, **more)

    a, b = of("a1", -10.0), of("a2", -12.5, method="filter-error")
    again = compare_runs([a, of("a4", -10.0 + 7e-8)])
    assert again.agreement.rows[-1][2:] == ("AIC above the best", "0", "0")
    assert compare_runs([a, b]).agreement.rows[-1][2:] == ("AIC above the best", "2.5", "0")
    for other in (of("b1", 0.0), of("a3", 0.0, method="frequency-error")):
        assert all(
            row[2] != "AIC above the best" for row in compare_runs([a, other]).agreement.rows
        )


def test_what_is_not_to_be_trusted_is_said_of_compared_and_listed_fits(tmp_path, capsys) -> None:
    sentence = "Not trusted: Ixx (closed loop without an instrument)."
    brief = "closed loop without an instrument"
    untrusted = {"Ixx": {"code": "loop.no-instrument", "brief": brief}}
    a = write_run(tmp_path / "a", {"Ixx": (0.02, 0.001)})
    against = {"untrusted": untrusted, "distrust": sentence, "adequate": False}
    withdrawn = Estimate(0.03, 0.001, None, None, "kg m^2", 1.0, 0.0, False, 0.001)._asdict()
    b = write_run(tmp_path / "b", {}, parameters={"Ixx": withdrawn}, **against)
    compared = compare_runs([a, b])
    assert [row[1:3] for row in compared.estimates.rows] == [
        ("0.0200 ± 0.0010", "0.0300 (not trusted)")
    ]
    assert compared.verdicts.rows[1][4] == f"The data determine all. {sentence}"
    said = [n.code for n in compared.notes if n.subjects == ("b",)]
    assert said == ["compared.not-trusted", "compared.not-adequate"]
    assert cli.main(["runs", str(tmp_path), "--json"]) == 0
    assert [r["untrusted"] for r in json.loads(capsys.readouterr().out)] == ["", "Ixx"]


def test_what_flights_share_is_compared_too(tmp_path: Path) -> None:
    def of(value: float, sd: float | None, unit: str, *, at_bound: bool = False) -> dict:
        ends = (None, None) if sd is None else (value - 1.96 * sd, value + 1.96 * sd)
        return Estimate(value, sd, *ends, unit, 1.0, 0.0, at_bound)._asdict()

    a = {"sigma_w": of(2.0, 0.3, "rad/s^2"), "flight 1/bias p": of(0.1, 0.1, "rad/s")}
    b = {"sigma_w": of(0.0, None, "rad/s^2", at_bound=True), "time_shift": of(0.05, 0.01, "s")}
    runs = [
        write_run(tmp_path / name, {"Ixx": (0.02, 0.001)}, nuisance=nuisance)
        for name, nuisance in (("a", a), ("b", b))
    ]
    rows = {row[0]: row[1:] for row in compare_runs(runs).estimates.rows}
    assert rows["sigma_w"] == ("2.00 ± 0.30", "0", "–", "rad/s²")
    assert rows["time_shift"] == ("–", "0.050 ± 0.010", "–", "s")
    assert set(rows) == {"Ixx", "sigma_w", "time_shift"}


def test_the_commands_list_and_compare(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile = "<script>alert(1)</script>"
    a = write_run(tmp_path / "runs" / "a", {"Ixx": (0.02, 0.001)}, model=hostile)
    one_log = [{"flight": "flight 1", "hold_out": False, "sha256": "a"}]
    b = write_run(tmp_path / "runs" / "deeper" / "b", {"Ixx": (0.03, 0.001)}, data=one_log)
    (tmp_path / "runs" / "c").mkdir()
    (tmp_path / "runs" / "c" / "fit.json").write_text("[1]")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["runs", "--json"]) == 0
    assert {r["run"] for r in json.loads(capsys.readouterr().out)} == {"a", "deeper/b"}
    page = tmp_path / "out.html"
    assert cli.main(["compare", str(a), str(b), "--out", str(page)]) == 0
    out = capsys.readouterr().out
    assert "2 - 1 [sd]" in out
    assert "+7.1" in out
    html = page.read_text()
    assert hostile not in html
    assert "&lt;script&gt;" in html
    # The page loads nothing: a browser loads only addresses in src or href.
    assert not re.search(r"(src|href)=.?(http|\/\/)", html)


@pytest.mark.parametrize(
    "arguments",
    [["compare", "a"], ["compare", "a", "none"], ["compare", "a", "b", "--out", "x.pdf"]],
)
def test_wrong_runs_end_in_a_sentence(
    arguments: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        write_run(tmp_path / name, {"Ixx": (0.02, 0.001)})
    assert cli.main(arguments) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    with pytest.raises(InputError, match="two runs"):
        compare_runs([tmp_path / "a"])


@pytest.mark.parametrize(
    "change",
    [
        {"parameters": {"Ixx": 3}},
        {"parameters": {"Ixx": {"value": "1e"}}},
        {"metrics": {"p": {"vaf": []}}},
        {"data": [{"flight": "flight 1", "sha256": "a", "window": 3}, 7]},
        {"data": 7},
        {"verdict": "all"},
        {"findings": [3]},
        {"untrusted": 5},
        {"determined_combinations": [3]},
        {"residuals": [1]},
    ],
)
def test_a_damaged_run_ends_in_a_sentence(tmp_path: Path, change: dict[str, object]) -> None:
    good = write_run(tmp_path / "a", {"Ixx": (0.02, 0.001)})
    bad = write_run(tmp_path / "b", {"Ixx": (0.02, 0.001)}, **change)
    with pytest.raises(InputError):
        compare_runs([good, bad])
    with pytest.raises(InputError):
        compare_runs([bad, good])


@pytest.mark.parametrize(
    "signals",
    [b"", b"flight,time\n\n", b"flight,time,p\na,1\n", b"flight,time,p\na,x,y\n", b"\xff"],
)
def test_damaged_signals_end_in_a_sentence(tmp_path: Path, signals: bytes) -> None:
    run = write_run(tmp_path / "a", {"Ixx": (0.02, 0.001)})
    (run / "signals.csv").write_bytes(signals)
    with pytest.raises(InputError):
        load_fit(run)
