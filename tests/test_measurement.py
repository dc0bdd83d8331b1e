"""Filters and delays between motion and log in a configuration."""

import re

import numpy as np
import pytest
import scipy.signal
import yaml

from heli_jax import config as configuration
from heli_jax.config.firmware_filters import logged_filters
from heli_jax.config.logs import read_flights
from heli_jax.dynamics.onboard.filters import Filter
from heli_jax.errors import InputError
from heli_jax.linear_models.read import linear_model
from heli_jax.models import with_filters

DT = 0.005
TIMES = DT * np.arange(2000)


def stick(times):
    return 0.1 * np.sign(np.sin(2.3 * times) + 0.5 * np.sin(5.1 * times))


def write_log(path, p, parameters=(("INS_GYRO_FILTER", 20.0),)):
    """Write a DataFlash log in text, with a gyro and sticks as sent."""
    text = ["FMT, 130, 27, IMU, Qdd, TimeUS,GyrX,C1"]
    text += ["FMT, 140, 31, PARM, QNf, TimeUS,Name,Value"]
    text += [f"PARM, 0, {n}, {v}" for n, v in parameters]
    for t, u, x in zip(TIMES, stick(TIMES), p, strict=True):
        text.append(f"IMU, {round(1e6 * t)}, {x:.9g}, {u:.9g}")
    path.write_text("\n".join(text) + "\n")


def flight(log="flight.log", **p):
    p = {"signal": "IMU.GyrX", "sd": 0.01, **p}
    signals = {"inputs": {"lat": {"signal": "IMU.C1", "unit": "1"}}, "outputs": {"p": p}}
    return {"log": log, "signals": signals}


@pytest.fixture
def load(tmp_path):
    """Return load(flight, ...), the experiment with these flights."""

    def load(*flights, **content):
        path = tmp_path / "config.yaml"
        content = {"model": {"linear": "roll-flybarless"}, "flights": list(flights), **content}
        path.write_text(yaml.safe_dump({"fit": {"free": {"Blat": {"start": 0.1}}}, **content}))
        return configuration.load(path)

    write_log(tmp_path / "flight.log", np.sin(TIMES))
    return load


def test_a_filter_is_stated_or_read_from_the_log(load, tmp_path):
    bare = linear_model("roll-flybarless").model
    stated = load(flight(filter={"kind": "biquad", "hz": 20}, delay=0.004)).model
    assert stated is with_filters(bare, {"p": [Filter("biquad", 20.0)]}, {"p": 0.004})
    assert load(flight(filter="from log", delay=0.004)).model is stated
    assert load(flight(filter=[])).model is bare
    notches = [{"kind": "notch", "hz": 40, "bandwidth": 8}, {"kind": "pt2", "hz": 90}]
    cascade = load(flight(filter=notches))
    expected = [Filter("notch", 40.0, 5.0), Filter("pt2", 90.0)]
    assert cascade.model is with_filters(bare, {"p": expected})
    # The resolved configuration describes the same experiment.
    again = tmp_path / "again.yaml"
    again.write_text(yaml.safe_dump(configuration.resolved(cascade)))
    assert configuration.load(again).model is cascade.model


@pytest.mark.parametrize(
    "p",
    [
        {"filter": "pt1"},
        {"filter": {"kind": "pt9", "hz": 3}},
        {"filter": {"kind": "pt1", "hz": 3, "bandwidth": 2}},
        {"filter": {"kind": "notch", "hz": 3}},
        {"delay": 4},
        {"delay": "4 ms"},
        {"signal": "IMU.C1", "filter": "from log"},
        {"signal": "IMU.GyrZ", "filter": "from log"},
    ],
)
def test_errors_are_sentences(load, p):
    with pytest.raises(InputError):
        load(flight(**p))


def test_flights_share_the_model(load):
    with pytest.raises(
        InputError, match=r"flights\[1\].*\(none\) differ from those of flights\[0\]"
    ):
        load(flight(delay=0.01), flight())


def test_a_filter_that_is_not_modelled_is_a_caution(load, tmp_path):
    (source,) = [f.source for f in read_flights(load(flight()))]
    # A Butterworth filter of second order has a delay of sqrt(2)/omega: 11.25 ms.
    (caution,) = source.cautions
    assert (caution.code, caution.subjects) == ("filters.not-modelled", ("p",))
    assert caution.value == pytest.approx(0.01125, abs=1e-5)
    (modelled,) = read_flights(load(flight(filter="from log")))
    assert not modelled.source.cautions
    write_log(
        tmp_path / "flight.log", np.sin(TIMES), (("INS_GYRO_FILTER", 0), ("INS_HNTCH_ENABLE", 1))
    )
    (moving,) = read_flights(load(flight()))
    assert [c.code for c in moving.source.cautions] == ["filters.unknown-filter"]


ROTORFLIGHT = {
    "gyro_lpf1_type": "1", "gyro_lpf1_static_hz": "150", "gyro_lpf1_dyn_hz": "0,200",
    "gyro_lpf2_type": "2", "gyro_lpf2_static_hz": "100", "gyro_decimation_hz": "250",
    "gyro_notch_hz": "0,0", "gyro_notch_cutoff": "0,0",
}  # fmt: skip


def test_settings_of_firmwares():
    px4 = {"IMU_GYRO_CUTOFF": 40.0, "IMU_GYRO_NF0_FRQ": 60.0, "IMU_GYRO_NF0_BW": 12.0}
    logged = logged_filters("PX4 1.13", px4, "vehicle_angular_velocity.xyz[1]")
    assert logged.filters == (Filter("notch", 60.0, 5.0), Filter("biquad", 40.0))
    assert logged_filters("PX4 1.13", px4, "vehicle_attitude.q[0]") is None
    assert logged_filters("", {}, "gyroADC[0]") is None
    logged = logged_filters("Rotorflight 4.3.0", ROTORFLIGHT, "gyroADC[0]")
    assert logged.filters[2] == Filter("pt1", 150.0)
    # The same as SciPy's Bessel filters, whose frequency is that of 3 dB.
    for filters, order, hz in ((logged.filters[:2], 4, 250.0), (logged.filters[3:], 2, 100.0)):
        poles = scipy.signal.bessel(order, 2 * np.pi * hz, norm="mag", analog=True, output="zpk")[1]
        ours = [np.roots([1, 2 * np.pi * f.hz / f.q, (2 * np.pi * f.hz) ** 2]) for f in filters]
        np.testing.assert_allclose(np.sort(np.concatenate(ours)), np.sort(poles), rtol=1e-6)
    betaflight = {"gyro_lowpass_type": "0", "gyro_lowpass_hz": "90"}
    betaflight |= {"gyro_notch_hz": "200,0", "gyro_notch_cutoff": "150,100", "dyn_notch_count": "3"}
    logged = logged_filters("Betaflight 4.2", betaflight, "gyroADC[2]")
    # Q of a notch follows from its lower edge: f f1 / (f^2 - f1^2).
    assert logged.filters == (Filter("pt1", 90.0), Filter("notch", 200.0, 30000 / 17500))
    assert logged.unknown == ("dyn_notch_count = 3",)
    moving = {**ROTORFLIGHT, "gyro_lpf1_dyn_hz": "25,200"}
    logged = logged_filters("Rotorflight 4.3.0", moving, "gyroADC[0]")
    assert logged.unknown == ("gyro_lpf1_dyn_hz = 25,200",)
    assert Filter("pt1", 150.0) not in logged.filters
    # Newer versions number the types from 6 on differently.
    newer = {**ROTORFLIGHT, "gyro_lpf1_type": "7", "gyro_lpf2_type": "0"}
    logged = logged_filters("Rotorflight 4.6.0", newer, "gyroADC[0]")
    assert logged.unknown == ("gyro_lpf1_static_hz = 150 of type 7",)
    assert len(logged.filters) == 2


def test_raw_pulse_widths_are_doubted(load, tmp_path):
    write_log(tmp_path / "flight.log", np.sin(TIMES))
    text = (tmp_path / "flight.log").read_text()
    for level in ("-0.1", "0", "0.1"):
        pulse = f"{1500 + 1000 * float(level):.0f}"
        text = re.sub(rf", {level}$", f", {pulse}", text, flags=re.MULTILINE)
    (tmp_path / "flight.log").write_text(text)
    raw = flight()
    (read,) = read_flights(load(raw))
    (doubt,) = [c for c in read.source.cautions if c.code == "units.unlikely"]
    assert (doubt.subjects, doubt.value) == (("lat",), 1600)
    raw["signals"]["inputs"]["lat"] |= {"offset": 1500, "scale": 0.002}
    (read,) = read_flights(load(raw))
    assert "units.unlikely" not in {c.code for c in read.source.cautions}
    raw["signals"]["inputs"]["lat"] = {"signal": "IMU.C1", "unit": "us"}
    with pytest.raises(InputError, match=r'offset: 1500, scale: 0\.002, unit: "1"'):
        read_flights(load(raw))
