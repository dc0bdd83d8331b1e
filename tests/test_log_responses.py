"""`heli-jax frf`: responses of a known linear system, simulated by SciPy."""

import csv
import dataclasses
import json
import re

import numpy as np
import pytest
import scipy.signal

from heli_jax.analysis.attitude_responses import handling_gaps
from heli_jax.analysis.flight_responses import Pair, Settings, TransferRequest, flight_responses
from heli_jax.analysis.transfer_fit import Measured, TransferFit, fit_transfer
from heli_jax.cli import main
from heli_jax.dynamics.model import Axis
from heli_jax.flights import Flight
from heli_jax.linear_models.read import linear_model
from heli_jax.report.figures.bode import branch_of, seen_of
from heli_jax.report.responses import _content

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
    """Write a log of 12 / (s + 3) with a held stick, gusts and optional feedback."""
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


def test_a_log_becomes_responses_files_and_a_transfer_function(config, tmp_path):
    out = tmp_path / "out"
    assert main(["frf", str(config), "--out", str(out)]) == 0
    (fitted,) = json.loads((out / "transfer_functions.json").read_text())
    pole = fitted["denominator"][1]
    assert pole["lower95"] < 3.0 < pole["upper95"]
    assert pole["sd"] < 1.0
    # The hold delays the stick by half a sample, which is not part of the vehicle.
    assert fitted["delay_s"]["lower95"] < 0.0 < fitted["delay_s"]["upper95"]
    rows = list(csv.DictReader((out / "responses.csv").read_text().splitlines()))
    assert len(rows) == 120
    names = ("frequency_hz", "gain", "phase_deg", "phase_sd_deg", "half95_in_sd")
    hz, gain, phase, sd, half95 = (np.array([float(row[n]) for row in rows]) for n in names)
    assert half95 == pytest.approx(2.0, abs=0.1)
    H = gain * np.exp(1j * np.radians(phase))
    true = scipy.signal.freqz(ROLL[0].ravel(), ROLL[1], 2.0 * np.pi * hz * DT)[1]
    z = (H - true) / (np.radians(sd) * gain)
    assert np.mean(np.abs(np.stack([z.real, z.imag])) < 1.96) > 0.85
    # The angle is not logged, so the response is that of the rate over s. The loop has only the
    # hold's delay.
    (handling,) = json.loads((out / "handling_qualities.json").read_text())
    assert handling["integrated"]
    bandwidth = handling["data"]["numbers"]["phase_bandwidth"]
    # The phase -90 - atan(w / 3) deg passes -135 deg at the pole.
    assert bandwidth["value"] == pytest.approx(3.0, abs=3.0 * bandwidth["sd"])
    assert bandwidth["sd"] < 0.8
    assert handling["data"]["numbers"]["phase_delay"] is None
    page = (out / "responses.html").read_text()
    links = set(re.findall(r'<a href="([^"#]+)"', page))
    assert {"responses.csv", "figures/"} <= links
    assert all((out / link).exists() for link in links)
    assert (out / "figures/p-lat.svg").exists()


def test_a_transfer_function_without_all_of_its_numbers_is_not_converged():
    s = 1j * np.geomspace(0.5, 30.0, 60)
    H = 12.0 / (s + 3.0)
    at = Measured(s.imag, H, 0.02 * np.abs(H), 1e3, np.full(60, 0.95))
    wanted = [TransferRequest("lat", "p", 0, poles) for poles in (1, 3)]
    enough, more = (_content(w, fit_transfer(at, w.zeros, w.poles), 20.0) for w in wanted)
    assert (enough["status"], enough["converged"]) == ("converged", True)
    assert {} in more["denominator"]
    assert more["status"] != "converged"
    assert not more["converged"]


@pytest.mark.parametrize(("column", "value"), [(3, ""), (None, "0")])
def test_a_log_that_says_nothing_is_refused(config, tmp_path, column, value):
    log = tmp_path / "log.csv"
    head, *rows = [line.split(",") for line in log.read_text().splitlines()]
    kept = {head.index("gyro")} if column else {1, 2, 3}
    blank = [[value if i in kept else c for i, c in enumerate(row)] for row in rows]
    log.write_text("\n".join(",".join(row) for row in [head, *blank]))
    assert main(["frf", str(config), "--out", str(tmp_path / "none")]) == 2
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


def test_half_a_sample_of_delay_hangs_on_a_guess(config, tmp_path):
    """Test a held stick taken for a linear one: its delay is 10 ms too long."""
    known = config.read_text()
    config.write_text(known.replace(", hold: zero-order", ""))
    out = tmp_path / "guessed"
    assert main(["frf", str(config), "--out", str(out)]) == 0
    [late] = json.loads((out / "transfer_functions.json").read_text())
    config.write_text(known)
    assert main(["frf", str(config), "--out", str(tmp_path / "known")]) == 0
    [right] = json.loads((tmp_path / "known" / "transfer_functions.json").read_text())
    assert late["delay_s"]["value"] - right["delay_s"]["value"] == pytest.approx(0.01, abs=1e-3)


def test_degrees_that_are_read_as_radians_are_said(config, tmp_path):
    log = tmp_path / "log.csv"
    head, *rows = [line.split(",") for line in log.read_text().splitlines()]
    at = head.index("gyro")
    for row in rows:
        row[at] = str(np.degrees(float(row[at])))
    log.write_text("\n".join(",".join(row) for row in [head, *rows]))
    assert main(["frf", str(config), "--out", str(tmp_path / "degrees")]) == 0
    assert "unit: deg/s" in (tmp_path / "degrees" / "responses.html").read_text()
    assert main(["frf", str(config), "--set", "frequency.window=100", "--out", "none"]) == 2


def test_what_chance_makes_of_few_averages_sets_no_axes():
    omega = np.geomspace(1.0, 100.0, 120)
    coherence = np.where(omega < 20.0, 0.9, 0.15)  # 1/8 by chance
    pair = Pair(1.0 / (1j * omega), np.full(120, 1e-3), coherence)
    few, many = (seen_of(omega, pair, averages) for averages in (8.0, 100.0))
    assert few[omega < 15.0].all()
    assert not few[omega > 30.0].any()
    assert many.all()


@pytest.mark.parametrize(
    "change",
    [
        "frequency.band=[0.1, 5]",
        "frequency.band=[1, 30]",
        "frequency.band=[5, 1]",
        "frequency.window=200",
        "frequency.transfer_functions.0.output=q",
        "frequency.handling=[{input: lat, output: q}]",
        "frequency.handling=[{input: lat, output: p, gain: 2}]",
        "frequency.transfer_functions.0.zeros=3",
        "flights.0.signals.instruments={ped: {signal: sweep}}",
        "flights.0.signals.instruments={lat: {constant: 1}}",
    ],
)
def test_what_is_wrong_is_refused(config, tmp_path, change):
    out = tmp_path / "none"
    assert main(["frf", str(config), "--set", change, "--out", str(out)]) == 2
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


def test_a_transfer_function_that_cannot_be_fitted_keeps_nothing_else_back(config, tmp_path):
    with config.open("a") as file:
        file.write("    - {input: lat, output: p, zeros: 7, poles: 8, band: [0.5, 1.2]}\n")
        file.write("    - {input: lat, output: phi, poles: 1, delay: false}\n")
    out = tmp_path / "out"
    # As for a fit that is not identifiable, scripts must not get meaningless numbers.
    assert main(["frf", str(config), "--out", str(out)]) == 3
    one, many, other = json.loads((out / "transfer_functions.json").read_text())
    assert one["status"] == "converged"
    for none, poles in ((many, 8), (other, 1)):
        assert none["status"] == "not-identifiable"
        assert none["denominator"] == [{"value": 1.0}, *[{}] * poles]
        assert none["poles"] is None
    assert other["delay_s"] is None
    assert len(other["sentences"]) == 1


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


def test_an_order_that_is_too_low_is_called_so():
    quick = [flight(s) for s in range(2)]
    wanted = TransferRequest("lat", "p", 0, 1, delay=False)
    [(_, fit)] = flight_responses(quick, Settings(window=10.0, transfer_functions=(wanted,))).fits
    assert isinstance(fit, TransferFit)
    assert fit.chi_squared < 2.0
