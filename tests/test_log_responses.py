"""`heli-jax frf`: from a log to responses, by a known linear system that SciPy simulated."""

import csv
import dataclasses
import json
import re
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import scipy.signal
import xarray as xr

from heli_jax import output
from heli_jax.analysis.attitude_responses import handling_gaps
from heli_jax.analysis.flight_responses import Pair, Settings, Wanted, flight_responses
from heli_jax.analysis.transfer_fit import Measured, TransferFit, fit_transfer
from heli_jax.cli import main
from heli_jax.config.frequency_section import FrequencyConfig
from heli_jax.dynamics.model import Axis
from heli_jax.finding import note
from heli_jax.flights import Flight
from heli_jax.linear_models.read import linear_model
from heli_jax.report.figures.bode import branch_of, seen_of
from heli_jax.report.fitted_responses import NO_RESPONSES, FittedResponses
from heli_jax.report.responses import _content, fit_row, fit_sentences
from heli_jax.workflow import FitRun

DT = 0.02
ROLL = scipy.signal.cont2discrete(([12.0], [1.0, 3.0]), DT)
CONFIG = """
model: {linear: roll-flybarless}
vehicle:
  tau_f: {value: 0.07, unit: s}
  Lb: {value: 3600, unit: 1/s^2}
  Blat: {value: 0.14, unit: rad}
flights:
  - log: log.csv
    signals: &signals
      time: {signal: t}
      inputs: {lat: {signal: stick, unit: "1", hold: zero-order}}
      outputs: {p: {signal: gyro, unit: rad/s}}
      instruments: {lat: {signal: sweep}}
frequency:
  window: 10
  transfer_functions:
    - {input: lat, output: p, poles: 1}
"""


def record(seed: int, n: int = 6000, feedback: float = 0.0) -> dict[str, np.ndarray]:
    """Twelve over s + 3 from a stick that is held, with gusts, and a stick that may follow."""
    rng = np.random.default_rng(seed)
    b, a = ROLL[0].ravel()[1], ROLL[1][1]
    slow = scipy.signal.butter(1, 2.0, fs=1 / DT)
    sweep = scipy.signal.lfilter(*slow, rng.standard_normal(n))
    gust = scipy.signal.lfilter(*slow, rng.standard_normal(n))
    p, u = np.zeros(n), np.zeros(n)
    for k in range(n):
        u[k] = sweep[k] - (feedback * p[k] if k else 0.0)
        if k + 1 < n:
            p[k + 1] = -a * p[k] + b * (u[k] + 0.3 * gust[k])
    return {"t": DT * np.arange(n), "stick": u, "gyro": p, "sweep": sweep}


def flight(seed: int, **more: float) -> Flight:
    r = record(seed, **more)
    return Flight(
        dt=DT, inputs={"lat": r["stick"]}, outputs={"p": r["gyro"]}, instruments={"lat": r["sweep"]}
    )


@pytest.fixture
def config(tmp_path):
    columns = record(3, feedback=0.4)
    with (tmp_path / "log.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    path = tmp_path / "roll.yaml"
    path.write_text(CONFIG)
    return path


def test_a_log_becomes_responses_files_and_a_transfer_function(config, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["frf", str(config), "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert "lat to p, 0 zeros, 1 poles" in printed.out
    assert "by instrument" in printed.out
    # By its instrument: nothing is to be said of feedback.
    assert "do not follow" not in printed.err
    (fitted,) = json.loads((out / "transfer_functions.json").read_text())
    pole = fitted["denominator"][1]
    assert pole["lower95"] < 3.0 < pole["upper95"]
    assert pole["sd"] < 1.0
    # The hold of the stick is half a sample late, which is not the machine's.
    assert fitted["delay_s"]["lower95"] < 0.0 < fitted["delay_s"]["upper95"]
    data = xr.open_dataset(out / "responses.nc", engine="scipy")
    assert data["unit"].sel(input="lat", output="p") == "rad/s"
    assert {data[n].attrs["units"] for n in ("real", "imaginary", "sd")} == {"rad/s"}
    assert data["half95"].sel(output="p") == pytest.approx(2.0, abs=0.1)
    H = (data["real"] + 1j * data["imaginary"]).sel(input="lat", output="p").values
    omega = 2.0 * np.pi * data.frequency.values
    true = scipy.signal.freqz(ROLL[0].ravel(), ROLL[1], omega * DT)[1]
    z = (H - true) / data.sd.values[0, 0]
    assert np.mean(np.abs(np.stack([z.real, z.imag])) < 1.96) > 0.85
    rows = list(csv.DictReader((out / "responses.csv").read_text().splitlines()))
    assert len(rows) == 120
    assert float(rows[7]["gain"]) == pytest.approx(abs(H[7]), rel=1e-12)
    # The angle is not logged: that of the rate's response. The loop has no delay but the hold.
    assert "lat to p, integrated: bandwidth [rad/s] data" in printed.out
    (handling,) = json.loads((out / "handling_qualities.json").read_text())
    assert handling["integrated"]
    bandwidth = handling["data"]["numbers"]["phase_bandwidth"]
    # -90 - atan(w / 3) deg passes -135 deg at the pole.
    assert bandwidth["value"] == pytest.approx(3.0, abs=2.5 * bandwidth["sd"])
    assert bandwidth["sd"] < 0.8
    assert handling["data"]["numbers"]["phase_delay"] is None
    page = (out / "responses.html").read_text()
    assert "lat to p" in page
    assert "Handling qualities" in page
    links = set(re.findall(r'<a href="([^"#]+)"', page))
    assert {"responses.csv", "responses.nc", "figures/"} <= links
    assert all((out / link).exists() for link in links)
    assert "Configuration, in full" in page
    assert (out / "figures/p-lat.svg").exists()


def test_poles_are_told_by_frequency_and_damping_and_unstable_ones_are_doubted():
    s = 1j * np.geomspace(0.5, 30.0, 60)

    def fitted(damping: float) -> TransferFit:
        H = 50.0 / (s**2 + 2.0 * damping * 8.0 * s + 64.0)
        at = Measured(s.imag, H, 0.02 * np.abs(H), 1e3, np.full(60, 0.95))
        return fit_transfer(at, 0, 2)

    assert fit_row(fitted(0.3))[2] == "ω 8, ζ 0.3"
    assert not fit_sentences(fitted(0.3), 10.0)
    assert fit_row(fitted(-0.1))[2] == "ω 8, ζ −0.1"
    [_, said] = fit_sentences(fitted(-0.1), 10.0)
    assert "unstable (a pole with the real part +0.8 rad/s)" in said


def test_a_transfer_function_without_all_of_its_numbers_is_not_converged():
    s = 1j * np.geomspace(0.5, 30.0, 60)
    H = 12.0 / (s + 3.0)
    at = Measured(s.imag, H, 0.02 * np.abs(H), 1e3, np.full(60, 0.95))
    wanted = [Wanted("lat", "p", 0, poles) for poles in (1, 3)]
    enough, more = (_content(w, fit_transfer(at, w.zeros, w.poles), 20.0) for w in wanted)
    assert (enough["status"], enough["converged"]) == ("converged", True)
    assert {} in more["denominator"]
    assert more["status"] != "converged"
    assert not more["converged"]


@pytest.mark.parametrize(
    ("column", "value", "sentence"),
    [
        (3, "", "outputs.p: all its samples are missing"),
        (None, "0", "no input moves"),
    ],
)
def test_a_log_that_says_nothing_is_refused(config, tmp_path, capsys, column, value, sentence):
    log = tmp_path / "log.csv"
    head, *rows = [line.split(",") for line in log.read_text().splitlines()]
    kept = {head.index("gyro")} if column else {1, 2, 3}
    blank = [[value if i in kept else c for i, c in enumerate(row)] for row in rows]
    log.write_text("\n".join(",".join(row) for row in [head, *blank]))
    assert main(["frf", str(config), "--out", str(tmp_path / "none")]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_the_phase_keeps_its_branch_through_noise_and_through_missing_bins():
    omega = np.geomspace(1.0, 100.0, 120)
    true = -90.0 - 3.0 * omega  # a delay of 52 ms: 300 degrees more at the end
    rng = np.random.default_rng(0)
    H = np.exp(1j * np.radians(true))
    noisy, missing = (omega > 10.0) & (omega < 13.0), (omega > 3.0) & (omega < 3.4)
    H[noisy] = np.exp(2j * np.pi * rng.random(int(noisy.sum())))
    H[missing] = np.nan
    found = branch_of(omega, H, ~noisy & ~missing)
    assert np.max(np.abs((found - true)[~noisy & ~missing])) < 1e-6
    assert np.max(np.abs((found - true)[noisy])) < 200.0
    assert np.isnan(found[missing]).all()


def test_an_axis_without_a_stick_is_said_and_a_speed_has_no_handling_qualities():
    model = linear_model("roll-flybarless").model
    assert not handling_gaps(model, ["p"])
    pendulum = dataclasses.replace(model, axes=(Axis("swing", rate="p", angle="phi", stick="lat"),))
    assert not handling_gaps(pendulum, ["p", "phi"])
    nameless = dataclasses.replace(model, axes=())
    (said,) = handling_gaps(nameless, ["p", "phi"])
    assert "axes: {roll: {stick: INPUT}}" in said
    assert "output: phi" in said


def test_without_an_instrument_the_bias_by_feedback_is_said(config, tmp_path, capsys):
    text = config.read_text().replace("      instruments: {lat: {signal: sweep}}\n", "")
    config.write_text(text)
    assert main(["frf", str(config), "--out", str(tmp_path / "direct")]) == 0
    assert "lat: taken for an input that does not follow the outputs" in capsys.readouterr().err


def test_half_a_sample_of_delay_that_hangs_on_a_guess_is_said(config, tmp_path, capsys):
    """A stick that moves at every sample was held all the same: the delay is 10 ms too long."""
    known = config.read_text()
    config.write_text(known.replace(", hold: zero-order", ""))
    out = tmp_path / "guessed"
    assert main(["frf", str(config), "--out", str(out)]) == 0
    said = capsys.readouterr().err
    assert "lat: taken to move in straight lines between samples" in said
    assert "half a sample, 10 ms, shorter" in said
    assert "which is a guess" in (out / "responses.html").read_text()
    [late] = json.loads((out / "transfer_functions.json").read_text())
    config.write_text(known)
    assert main(["frf", str(config), "--out", str(tmp_path / "known")]) == 0
    assert "which is a guess" not in capsys.readouterr().err
    [right] = json.loads((tmp_path / "known" / "transfer_functions.json").read_text())
    assert late["delay_s"]["value"] - right["delay_s"]["value"] == pytest.approx(0.01, abs=1e-3)


def test_flights_that_a_fit_holds_out_are_said_to_count_here(config, tmp_path, capsys):
    held = "  - {log: log.csv, name: doublets, signals: *signals, hold_out: true}\nfrequency:"
    config.write_text(CONFIG.replace("frequency:", held))
    assert main(["frf", str(config), "--out", str(tmp_path / "out")]) == 0
    assert "doublets: used here as the other flights are" in capsys.readouterr().err


def test_degrees_that_are_read_as_radians_are_said(config, tmp_path, capsys):
    log = tmp_path / "log.csv"
    head, *rows = [line.split(",") for line in log.read_text().splitlines()]
    at = head.index("gyro")
    for row in rows:
        row[at] = str(np.degrees(float(row[at])))
    log.write_text("\n".join(",".join(row) for row in [head, *rows]))
    assert main(["frf", str(config), "--out", str(tmp_path / "degrees")]) == 0
    said = capsys.readouterr().err
    assert "'gyro' looks like deg/s read as rad/s; state unit: deg/s" in said
    assert "state unit: deg/s" in (tmp_path / "degrees" / "responses.html").read_text()
    assert main(["frf", str(config), "--set", "frequency.window=100", "--out", "none"]) == 2
    assert "a longer record, or a shorter window" in capsys.readouterr().err


def test_what_chance_makes_of_few_averages_sets_no_axes():
    omega = np.geomspace(1.0, 100.0, 120)
    coherence = np.where(omega < 20.0, 0.9, 0.15)  # chance makes an eighth of eight averages
    pair = Pair(1.0 / (1j * omega), np.full(120, 1e-3), coherence, np.full(120, np.nan + 0j))
    few, many = (seen_of(omega, pair, averages) for averages in (8.0, 100.0))
    assert few[omega < 15.0].all()
    assert not few[omega > 30.0].any()
    assert many.all()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("frequency.band=[0.1, 5]", "at least two periods in a window of 10 s, from 0.2 Hz on"),
        ("frequency.band=[1, 30]", "below half the rate of 50 Hz, got 30 Hz"),
        ("frequency.band=[5, 1]", "expected two increasing frequencies in Hz, got [5, 1]"),
        ("frequency.window=200", "the longest flight is 120 s, too short for a window"),
        ("frequency.transfer_functions.0.output=q", "has no output 'q'"),
        ("frequency.handling=[{input: lat, output: q}]", "handling[0].output: model"),
        ("frequency.handling=[{input: lat, output: p, gain: 2}]", "expected response: open-loop"),
        ("frequency.transfer_functions.0.zeros=3", "expected at most as many as poles (1), got 3"),
        ("flights.0.signals.instruments={ped: {signal: sweep}}", "has no input 'ped'"),
        ("flights.0.signals.instruments={lat: {constant: 1}}", "expected a signal of the log"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(config, tmp_path, capsys, change, sentence):
    out = tmp_path / "none"
    assert main(["frf", str(config), "--set", change, "--out", str(out)]) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def test_missing_samples_divide_a_record_and_too_many_leave_nothing():
    whole = flight(0)
    y = whole.outputs["p"].copy()
    y[2000:2010] = np.nan
    gap = Flight(dt=DT, inputs=whole.inputs, outputs={"p": y})
    settings = Settings(window=10.0)
    assert (
        flight_responses([gap], settings).outputs["p"].averages
        < flight_responses([whole], settings).outputs["p"].averages
    )
    y[::400] = np.nan
    with pytest.raises(ValueError, match="p: no response, expected a part of at least 500 samples"):
        flight_responses([Flight(dt=DT, inputs=whole.inputs, outputs={"p": y})], settings)


def test_where_a_signal_has_no_power_of_its_own_there_is_no_response():
    whole = flight(1)
    b, a = scipy.signal.butter(4, 1.0, fs=1 / DT)
    filtered = Flight(
        dt=DT,
        inputs={"lat": scipy.signal.lfilter(b, a, whole.inputs["lat"])},
        outputs={"p": scipy.signal.lfilter(b, a, whole.outputs["p"])},
    )
    found = flight_responses([filtered], Settings(window=10.0))
    H, hz = found.outputs["p"].pairs["lat"].H, found.omega / (2.0 * np.pi)
    assert np.isfinite(H[hz < 1.0]).all()
    assert np.isnan(H[hz > 15.0]).all()


def test_a_transfer_function_that_cannot_be_fitted_keeps_nothing_else_back(
    config, tmp_path, capsys
):
    with config.open("a") as file:
        file.write("    - {input: lat, output: p, zeros: 7, poles: 8, band: [0.5, 1.2]}\n")
        file.write("    - {input: lat, output: phi, poles: 1, delay: false}\n")
    out = tmp_path / "out"
    # As of a fit that is not identifiable: a script must not take numbers that are not there.
    assert main(["frf", str(config), "--out", str(out)]) == 3
    printed = capsys.readouterr().out
    assert "delay [ms]: " in printed
    assert "not fitted: expected more than 8.5 independent frequencies" in printed
    one, many, other = json.loads((out / "transfer_functions.json").read_text())
    assert one["status"] == "converged"
    for none, poles in ((many, 8), (other, 1)):
        assert none["status"] == "not-identifiable"
        assert none["denominator"] == [{"value": 1.0}, *[{}] * poles]
        assert none["poles"] is None
    assert other["delay_s"] is None
    assert other["sentences"] == ["not fitted: these flights have no response from lat to phi"]
    assert "not fitted: expected more than 8.5" in (out / "responses.html").read_text()


def test_an_output_of_too_few_averages_keeps_nothing_else_back():
    whole = flight(0)
    q = whole.outputs["p"].copy()
    q[600:] = np.nan
    both = Flight(dt=DT, inputs=whole.inputs, outputs={"p": whole.outputs["p"], "q": q})
    found = flight_responses([both], Settings(window=10.0))
    assert list(found.outputs) == ["p"]
    assert [n.subjects for n in found.notes if n.code == "responses.none"] == [("q",)]


def test_flights_of_two_rates_are_refused():
    other = Flight(dt=0.01, inputs=flight(0).inputs, outputs=flight(0).outputs)
    with pytest.raises(ValueError, match="expected flights of one rate, got 50, 100 Hz"):
        flight_responses([flight(0), other])


def test_a_fit_says_that_the_band_which_was_asked_for_has_no_responses(monkeypatch, capsys):
    monkeypatch.setattr(output, "missing_handling", lambda *_: ())
    notes = (note(NO_RESPONSES, "band: expected more"), note("a.note", "lat is still"))
    none = FittedResponses((), 0, (), "", notes)
    for asked in (None, FrequencyConfig()):
        run = SimpleNamespace(
            supplementary=SimpleNamespace(responses=none),
            config=SimpleNamespace(config=SimpleNamespace(frequency=asked)),
            problem=SimpleNamespace(training=()),
        )
        output._print_handling(cast(FitRun, run))
        said = "! band: expected more\n" if asked else ""
        assert capsys.readouterr().out == said


def test_an_order_that_is_too_low_is_called_so():
    quick = [flight(s) for s in range(2)]
    wanted = Wanted("lat", "p", 0, 1, delay=False)
    [(_, fit)] = flight_responses(quick, Settings(window=10.0, transfer_functions=(wanted,))).fits
    assert isinstance(fit, TransferFit)
    assert fit.chi_squared < 2.0
