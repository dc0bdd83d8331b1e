"""Presets: consistency, and configurations that read and fit a log with one."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.signal import cont2discrete

from heli_jax import cli, config, models, naming, units
from heli_jax.errors import InputError
from heli_jax.flights.derived import sources
from heli_jax.flights.open_log import open_log
from heli_jax.flights.preset import (
    fitting_presets,
    meanings,
    model_inputs,
    model_outputs,
    preset,
    presets,
)
from heli_jax.linear_models.read import linear_model, shipped
from heli_jax.workflow import run_fit

from . import log_writers as writers

ROOT = Path(__file__).parents[2]
DATA = ROOT / ".." / "shared" / "data"
ULOG, BIN = DATA / "ulog" / "sample_log_small.ulg", DATA / "dataflash" / "test.BIN"
BLACKBOX = DATA / "rotorflight" / "LOG246.TXT"
ABSENT = "the real logs are not at ../shared/data"
PX4, ARDUPILOT = (ROOT / "configs" / "logs" / f"{n}-roll.yaml" for n in ("px4", "ardupilot"))


@pytest.mark.parametrize("name", presets())
def test_a_preset_is_consistent(name):
    table = preset(name)
    assert table.version >= 1
    for signal, alternatives in table.signals.items():
        assert alternatives
        for a in alternatives:
            units.factor(a.unit, meanings()[signal].unit)
            assert sources(a.channel, ())
            assert a.source
            assert a.scale > 0  # `invert` states the sign
    assert not set(table.missing) & set(table.signals)
    assert set(table.missing) <= set(meanings())
    commands = {s.command for s in model_inputs().values()}
    assert commands <= set(table.signals) | set(table.missing)


def test_the_models_signals_have_the_presets_units():
    every = [*(models.by_name(n) for n in ("roll", "pitch", "helicopter"))]
    every += [linear_model(name).model for name in shipped()]
    for model in every:
        for name in naming.names(model.Outputs):
            if name in model_outputs():
                unit = naming.unit(model.Outputs, name)
                assert units.factor(meanings()[model_outputs()[name]].unit, unit) == 1.0
        for name in set(naming.names(model.Inputs)) - {"x_throttle"}:
            known = model_inputs()[name]
            assert {known.command, known.stick} <= set(meanings())


LB, BLAT, TAU = 150.0, 0.12, 0.04631
STEPS = [(3, 1), (2, -1), (1, 1), (1, -1), (4, 0)]


def flown():
    """Return 13 s of roll at 100 Hz by SciPy's discretisation: stick, roll rate, roll angle."""
    stick = (
        np.repeat([0.0, *[s for n, s in STEPS for _ in range(n)]] * 5, 27)[:1300] * 0.2 / 0.75**0.5
    )
    a = np.array([[0, 1, 0], [0, 0, LB], [0, -1, -1 / TAU]])
    b = np.array([[0], [0], [BLAT / TAU]])
    a, b, *_ = cont2discrete((a, b, np.eye(3), np.zeros((3, 1))), 0.01)
    x = np.zeros((1300, 3))
    for k in range(1299):
        x[k + 1] = a @ x[k] + b[:, 0] * stick[k]
    rng = np.random.default_rng(7)
    phi, p = x[:, 0] + 1e-3 * rng.normal(size=1300), x[:, 1] + 5e-3 * rng.normal(size=1300)
    return stick, p, phi


STICK, P, PHI = flown()
VECTOR = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), ("float[3]", "xyz")]
CONTROL = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), ("float[4]", "control")]
QUATERNION = [("uint64_t", "timestamp"), ("float[4]", "q")]


def px4_log(path, **topics):
    us = [20_000_000 + 10_000 * k for k in range(1300)]
    half = np.cos(PHI / 2), np.sin(PHI / 2)
    rows = {
        # Published 3 ms after the measurement.
        "vehicle_angular_velocity": (VECTOR, [(t + 3000, t, P[k], 0, 0) for k, t in enumerate(us)]),
        "vehicle_attitude": (
            QUATERNION,
            [(t, c, s, 0, 0) for t, c, s in zip(us, *half, strict=True)],
        ),
        # The stamp of the gyro sample that it uses, 2 ms before it acts.
        "actuator_controls_0": (
            CONTROL,
            [(t, t - 2000, STICK[k], 0, 0, 0.5) for k, t in enumerate(us)],
        ),
    } | topics
    made = [(name, 0, fields, data) for name, (fields, data) in rows.items()]
    path.write_bytes(writers.ulog(made, start=20_000_000))
    return path


MESSAGES = {
    "RATE": (150, "Qfff", "TimeUS,RDes,R,ROut"),
    "ATT": (151, "Qff", "TimeUS,DesRoll,Roll"),
    "RCOU": (152, "QHHHH", "TimeUS,C1,C2,C3,C4"),
}


def ardupilot_log(path):
    lift = np.round(STICK * 0.75**0.5 / 0.002).astype(int)
    rows = []
    for k in range(1300):
        t = 5_000_000 + 10_000 * k
        rows.append(("RATE", (t, 0, np.degrees(P[k]), 0)))
        rows.append(("ATT", (t, 0, np.degrees(PHI[k]))))
        rows.append(("RCOU", (t, 1500 + lift[k], 1500 - lift[k], 1500, 1000)))
    path.write_bytes(writers.dataflash(MESSAGES, rows))
    return path


def test_from_a_log_to_a_fit(tmp_path):
    log = ardupilot_log(tmp_path / "flight.bin")
    run = run_fit(config.load(ARDUPILOT, {"flights.0.log": str(log)}))
    for name, truth in {"Lb": LB, "Blat": BLAT}.items():
        assert run.fit.estimates[name].value == pytest.approx(truth, rel=0.02)
    source = run.problem.flights[0].source
    assert (source.outputs["phi"].name, source.inputs["lat"].name) == ("ATT.Roll", "ccpm.roll")


def test_a_command_acts_when_it_is_published_and_a_rate_was_so_when_it_was_measured(tmp_path):
    path = px4_log(tmp_path / "flight.ulg")
    log = open_log(path)
    assert log.topic_of("actuator_controls_0.control[0]").clock == "timestamp"
    assert log.topic_of("vehicle_angular_velocity.xyz[0]").clock == "timestamp_sample"
    (flight,) = config.read_flights(config.load(PX4, {"flights.0.log": str(path)}))
    assert flight.source.inputs["lat"].name == "actuator_controls_0.control[0]"
    assert flight.source.outputs["phi"].name == "euler(vehicle_attitude.q).roll"


def read(tmp_path, log, signals, **changes):
    """Return the flight of a configuration with a log and a section `signals`."""
    content = {"model": {"linear": "roll-flybarless"}}
    content |= {k: v for k, v in changes.items() if k in ("model", "onboard", "vehicle")}
    flight = {k: v for k, v in changes.items() if k not in content}
    content["flights"] = [{"log": str(log), "signals": signals, "rate": 100, **flight}]
    path = tmp_path / "flight.yaml"
    path.write_text(yaml.safe_dump(content))
    (read,) = config.read_flights(config.load(path))
    return read


def test_scales_offsets_signs_and_constants(tmp_path):
    t = np.arange(40) / 20
    lines = [f"{a},{1500 + 400 * np.sin(a)},{3 * a}" for a in t]
    (tmp_path / "b.csv").write_text("\n".join(["t,pwm,angle", *lines]))
    inputs = {
        "lat": {"signal": "pwm", "offset": 1500, "scale": 0.002, "invert": True},
        "lon": {"constant": 25, "unit": "%"},
        "ped": {"constant": 0},
    }
    outputs = {"r": {"signal": "angle", "unit": "deg/s", "offset": 1}}
    signals = {"time": {"signal": "t"}, "inputs": inputs, "outputs": outputs}
    model = {"linear": "attitude-flybarless"}
    flight = read(tmp_path, tmp_path / "b.csv", signals, model=model, rate=20)
    np.testing.assert_allclose(flight.inputs["lat"], -0.8 * np.sin(t), atol=1e-12)
    np.testing.assert_array_equal(flight.inputs["lon"], np.full(40, 0.25))
    np.testing.assert_allclose(flight.outputs["r"], np.radians(3 * t - 1), atol=1e-12)
    assert list(flight.inputs) == ["lat", "lon", "ped"]
    assert flight.hold_reason["lon"] == "a constant"
    assert flight.source.inputs["lat"].invert
    # All inputs may be constant: a free decay.
    inputs["lat"] = {"constant": 0.1}
    flight = read(tmp_path, tmp_path / "b.csv", signals, model=model, rate=20)
    np.testing.assert_array_equal(flight.inputs["lat"], np.full(40, 0.1))


@pytest.mark.parametrize(
    "lat",
    [
        {"signal": "x", "scale": 0},
        {"signal": "x", "scale": float("inf")},
        {"signal": "x", "scale": -1, "invert": True},
        {"signal": "x", "offset": 1e13},
        {"signal": "x", "invert": "yes"},
        {"signal": "x", "constant": 1.0},
        {},
        {"constant": 1.0, "scale": 2.0},
    ],
)
def test_scales_that_make_no_sense(tmp_path, lat):
    signals = {"inputs": {"lat": lat}, "outputs": {"p": {"signal": "p"}}}
    with pytest.raises(InputError, match="lat"):
        read(tmp_path, tmp_path / "none.csv", signals)


def test_alternatives_instances_and_what_was_left_out(tmp_path):
    log = px4_log(tmp_path / "a.ulg", vehicle_attitude=(QUATERNION, []))
    flight = read(tmp_path, log, {"preset": "px4-helicopter"})
    assert list(flight.outputs) == ["p"]
    (note,) = (n for n in flight.source.notes if n.code == "channels.lacking")
    assert "phi" in note.subjects
    # The newer topic has precedence, and the first of two instances is used.
    us = [20_000_000 + 10_000 * k for k in range(1300)]
    torque = [(t, t, 0.5 * STICK[k], 0, 0) for k, t in enumerate(us)]
    made = [("vehicle_torque_setpoint", i, VECTOR, torque) for i in (0, 1)]
    made.append(("vehicle_angular_velocity", 0, VECTOR, [(t, t, 0, 0, 1) for t in us]))
    made.append(("actuator_controls_0", 0, CONTROL, [(t, t, 0, 0, 0, 0) for t in us]))
    (tmp_path / "b.ulg").write_bytes(writers.ulog(made, start=20_000_000))
    flight = read(tmp_path, tmp_path / "b.ulg", {"preset": "px4-helicopter"})
    np.testing.assert_allclose(flight.inputs["lat"], 0.5 * STICK, atol=1e-7)
    assert flight.source.inputs["lat"].name == "vehicle_torque_setpoint[0].xyz[0]"


def test_what_is_named_goes_before_the_preset(tmp_path):
    log = px4_log(tmp_path / "a.ulg")
    inputs = {"lat": {"signal": "actuator_controls_0.control[3]"}}
    signals = {"preset": "px4-helicopter", "preset_outputs": ["p"], "inputs": inputs}
    np.testing.assert_array_equal(read(tmp_path, log, signals).inputs["lat"], 0.5)
    signals = {"preset": "px4-helicopter", "outputs": {"p": {"signal": "vehicle_attitude.q[0]"}}}
    flight = read(tmp_path, log, signals)
    assert flight.source.outputs["p"].name == "vehicle_attitude.q[0]"
    assert list(flight.outputs) == ["p", "phi"]


def test_a_rate_loop_stands_behind_the_pilots_stick(tmp_path):
    us = [20_000_000 + 10_000 * k for k in range(1300)]
    manual = [("uint64_t", "timestamp"), ("float", "x"), ("float", "y"), ("float", "z")]
    rows = [(t, 0, STICK[k] / 2, 0) for k, t in enumerate(us)]
    log = px4_log(tmp_path / "a.ulg", manual_control_setpoint=(manual, rows))
    vehicle = {"Kc_lat": 1, "Kp_lat": 0.1, "Ki_lat": 1, "Kff_lat": 0.1}
    changes = {"onboard": {"rate_loop": {"on": ["lat"]}}, "vehicle": vehicle}
    flight = read(tmp_path, log, {"preset": "px4-helicopter"}, **changes)
    assert flight.source.inputs["lat"].name == "manual_control_setpoint.y"


PX4_PRESET = {"preset": "px4-helicopter"}


@pytest.mark.parametrize(
    ("signals", "changes"),
    [
        ({"preset": "px4-heli"}, {}),
        ({"preset_outputs": ["p"]}, {}),
        (PX4_PRESET | {"preset_outputs": ["pp"]}, {}),
        (PX4_PRESET, {"model": {"linear": "yaw"}, "log": "empty"}),
        ({"preset": "ardupilot-helicopter"}, {}),
        (PX4_PRESET | {"preset_outputs": ["w"]}, {"model": {"linear": "heave"}}),
        (PX4_PRESET, {"model": {"linear": "heave"}}),
    ],
)
def test_what_a_preset_cannot_supply(tmp_path, signals, changes):
    topics = {"actuator_controls_0": (CONTROL, [])} if changes.get("log") else {}
    log = px4_log(tmp_path / "a.ulg", **topics)
    changes = {k: v for k, v in changes.items() if k != "log"}
    with pytest.raises(InputError):
        read(tmp_path, log, signals, **changes)


def test_a_table_with_the_channels_names_will_do(tmp_path):
    names = ["t", "vehicle_angular_velocity.xyz[0]", "actuator_controls_0.control[0]"]
    rows = [f"{k / 100},{P[k]},{STICK[k]}" for k in range(400)]
    (tmp_path / "converted.csv").write_text("\n".join([",".join(names), *rows]))
    signals = {"preset": "px4-helicopter", "time": {"signal": "t"}}
    flight = read(tmp_path, tmp_path / "converted.csv", signals)
    np.testing.assert_allclose(flight.outputs["p"], P[:400], atol=1e-12)
    (tmp_path / "other.csv").write_text("t,x\n" + "\n".join(f"{k},{k}" for k in range(20)))
    with pytest.raises(InputError):
        read(tmp_path, tmp_path / "other.csv", signals)


@pytest.mark.skipif(not ULOG.exists(), reason=ABSENT)
def test_the_real_ulog_by_its_preset(tmp_path):
    (flight,) = [read(tmp_path, ULOG, {"preset": "px4-helicopter"}, window=[1, 6])]
    # The attitude's mean rate equals the gyro's.
    turn = flight.outputs["phi"][-1] - flight.outputs["phi"][0]
    assert turn == pytest.approx(np.trapezoid(flight.outputs["p"], dx=flight.dt), abs=0.1)
    model = {"linear": "hybrid-flybarless"}
    whole = read(tmp_path, ULOG, {"preset": "px4-helicopter"}, window=[1, 6], model=model)
    assert set(whole.inputs) == {"lat", "lon", "ped", "col"}
    assert set(whole.outputs) == {"u", "v", "w", "p", "q", "r", "phi", "theta"}


@pytest.mark.skipif(not BIN.exists(), reason=ABSENT)
def test_the_real_dataflash_by_its_preset(tmp_path):
    inputs = {"lat": {"signal": "IMU2.GyrX"}}
    signals = {"preset": "ardupilot-helicopter", "inputs": inputs}
    with pytest.raises(InputError):
        read(tmp_path, BIN, signals | {"inputs": {}})
    flight = read(tmp_path, BIN, signals, rate=20)
    assert flight.source.outputs["p"].name == "IMU.GyrX"
    assert set(flight.outputs) == {"p", "phi"}


@pytest.mark.skipif(not BLACKBOX.exists(), reason=ABSENT)
def test_the_real_blackbox_by_its_preset(tmp_path):
    model = {"linear": "attitude-flybarless"}
    signals = {"preset": "rotorflight"}
    with pytest.raises(InputError):
        read(tmp_path, BLACKBOX, signals, model=model)
    signals["inputs"] = {"ped": {"signal": "mixer[2]", "scale": 0.001}}
    flight = read(tmp_path, BLACKBOX, signals, model=model, window=[1, 18])
    assert set(flight.outputs) == {"p", "q", "r"}
    assert np.abs(flight.inputs["lat"]).max() < 1.0
    pitch = read(
        tmp_path, BLACKBOX, {"preset": "rotorflight"}, model={"linear": "pitch-flybarless"}
    )
    # Gyro and attitude agree in sign and size as flown: nose up in both.
    turn = np.cumsum(pitch.outputs["q"]) * pitch.dt
    slope = np.polyfit(turn, pitch.outputs["theta"], 1)[0]
    assert slope == pytest.approx(1.0, abs=0.25)


def test_info_names_the_presets_that_fit(tmp_path, capsys):
    log = px4_log(tmp_path / "a.ulg")
    assert cli.main(["info", str(log)]) == 0
    assert "preset: px4-helicopter" in capsys.readouterr().out
    assert fitting_presets("dataflash", ["RATE.R", "RATE.ROut"]) == ["ardupilot-helicopter"]
    assert fitting_presets("dataflash", ["IMU[0].GyrX", "RATE.ROut"]) == ["ardupilot-helicopter"]
    assert fitting_presets("csv", ["RATE.R", "RATE.ROut"]) == []
