"""`heli-jax new` for autopilot logs: filters from their settings, and the grid's rate."""

import numpy as np
import pytest
import yaml

from heli_jax import cli
from heli_jax.config import load, read_flights
from heli_jax.errors import InputError
from heli_jax.new_config import write_config

from . import log_writers as writers

VECTOR = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), ("float[3]", "xyz")]
QUATERNION = [("uint64_t", "timestamp"), ("float[4]", "q")]
MESSAGES = {
    "PARM": (149, "QNf", "TimeUS,Name,Value"),
    "RATE": (150, "Qfff", "TimeUS,RDes,R,ROut"),
    "ATT": (151, "Qff", "TimeUS,DesRoll,Roll"),
}
US = [20_000_000 + 10_000 * k for k in range(800)]
STICK = 0.2 * np.sign(np.sin(np.arange(800) / 60))
RATE = 0.3 * np.sin(np.arange(800) / 60) + 0.01 * np.random.default_rng(1).normal(size=800)


def px4_log(path, settings, axis=0):
    """Write a gyro at 100 Hz, stick and attitude at 50 Hz; one axis moves."""
    rate = [(t, t, *np.roll((p, 0, 0), axis)) for t, p in zip(US, RATE, strict=True)]
    stick = [(t, t, *np.roll((u, 0, 0), axis)) for t, u in zip(US, STICK, strict=True)]
    topics = [
        ("vehicle_angular_velocity", 0, VECTOR, rate),
        ("vehicle_attitude", 0, QUATERNION, [(t, 1, 0, 0, 0) for t in US[::2]]),
        ("vehicle_torque_setpoint", 0, VECTOR, stick[::2]),
    ]
    path.write_bytes(writers.ulog(topics, start=US[0], parameters=settings))
    return path


def ardupilot_log(path, settings):
    rows = [("PARM", (US[0], name.encode(), value)) for name, value in settings]
    for t, p, u in zip(US, RATE, STICK, strict=True):
        rows += [("RATE", (t, 0, np.degrees(p), u)), ("ATT", (t, 0, 0))]
    path.write_bytes(writers.dataflash(MESSAGES, rows))
    return path


def cautions(tmp_path, log, model=None):
    """Return the configuration, and the codes of a fit's findings on its flight."""
    out = tmp_path / "new.yaml"
    write_config(log, out, model)
    (flight,) = read_flights(load(out))
    return yaml.safe_load(out.read_text()), {c.code for c in flight.source.cautions}


def test_a_gyro_behind_a_filter_is_written_with_it(tmp_path):
    log = px4_log(tmp_path / "flight.ulg", [("IMU_GYRO_CUTOFF", 30.0)])
    written, said = cautions(tmp_path, log)
    (p,) = written["flights"][0]["signals"]["outputs"].values()
    wanted = {"signal": "vehicle_angular_velocity.xyz[0]", "unit": "rad/s", "filter": "from log"}
    assert p == wanted
    assert "filters.not-modelled" not in said


def test_so_is_one_in_degrees_of_another_autopilot(tmp_path):
    log = ardupilot_log(tmp_path / "flight.bin", [("INS_GYRO_FILTER", 20.0)])
    written, said = cautions(tmp_path, log)
    outputs = written["flights"][0]["signals"]["outputs"]
    assert outputs == {"p": {"signal": "RATE.R", "unit": "deg/s", "filter": "from log"}}
    assert "filters.not-modelled" not in said


def test_without_such_settings_nothing_is_written_of_filters(tmp_path):
    written, _ = cautions(tmp_path, px4_log(tmp_path / "flight.ulg", []))
    assert "outputs" not in written["flights"][0]["signals"]


def test_the_rate_is_that_of_the_outputs_that_are_taken_and_not_the_slower_sticks(tmp_path):
    written, _ = cautions(tmp_path, px4_log(tmp_path / "flight.ulg", []))
    assert written["flights"][0]["rate"] == 100


def test_the_caution_of_a_filter_is_a_line_that_may_be_pasted(tmp_path):
    log = ardupilot_log(tmp_path / "flight.bin", [("INS_GYRO_FILTER", 20.0)])
    out = tmp_path / "own.yaml"
    signals = {"preset": "ardupilot-helicopter", "preset_outputs": ["p"]}
    flight = {"log": str(log), "rate": 100, "signals": signals}
    out.write_text(
        yaml.safe_dump({"model": {"linear": "roll-flybarless"}, "flights": [flight], "rls": None})
    )
    (read,) = read_flights(load(out))
    line = 'p: {signal: "RATE.R", unit: deg/s, filter: from log}'
    [caution] = [c for c in read.source.cautions if c.code == "filters.not-modelled"]
    assert line in caution.sentence
    flight["signals"] = {**signals, "outputs": yaml.safe_load(line)}
    out.write_text(
        yaml.safe_dump({"model": {"linear": "roll-flybarless"}, "flights": [flight], "rls": None})
    )
    (read,) = read_flights(load(out))
    assert not read.source.cautions


OLD = """ArduCopter V2.9.1b (c0c4bd3f)
FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 1, 19, ATT, cccccCC, RollIn,Roll,PitchIn,Pitch,YawIn,Yaw,NavYaw
"""


def test_rows_without_times_are_refused_by_new_and_described(tmp_path):
    log = tmp_path / "old.log"
    rows = [f"ATT, {k % 7}.00, {k % 5}.10, 0.00, 0.00, 0.00, 1.00, 1.00" for k in range(60)]
    log.write_text(OLD + "\n".join(rows) + "\n")
    for model in ([], ["--model", "roll-flybarless"]):
        assert cli.main(["new", str(log), "--out", str(tmp_path / "new.yaml"), *model]) == 2
    assert cli.main(["info", str(log)]) == 0


def test_no_rotor_is_written_for_another_vehicle(tmp_path):
    log = px4_log(tmp_path / "flight.ulg", [("MAV_TYPE", 22)])
    out = tmp_path / "new.yaml"
    with pytest.raises(InputError):
        write_config(log, out)
    assert not out.exists()
    write_config(log, out, "linear:roll")
    assert out.exists()


@pytest.mark.parametrize(
    ("settings", "axis", "model", "inputs", "outputs"),
    [
        ([], 1, "roll-flybarless", "lat", "p"),
        ([("MAV_TYPE", 4)], 0, "roll-flybarless", "lat", "p"),
        ([("CA_AIRFRAME", 0)], 0, "rate-first-order", "lat lon ped", "p q r"),
        ([("MAV_TYPE", 1)], 0, "lateral-directional", "ail rud", "p r phi"),
        ([("MAV_TYPE", 1)], 1, "short-period", "ele", "q"),
    ],
)
def test_the_model_is_for_the_firmwares_vehicle(tmp_path, settings, axis, model, inputs, outputs):
    out = tmp_path / "new.yaml"
    write_config(px4_log(tmp_path / "flight.ulg", settings, axis), out)
    text = out.read_text()
    assert yaml.safe_load(text)["model"] == {"linear": model}
    # The travel of a control surface is not in the log.
    out.write_text(text.replace("scale: EDIT", "scale: 0.3"))
    (flight,) = read_flights(load(out))
    assert (" ".join(flight.inputs), " ".join(flight.outputs)) == (inputs, outputs)
