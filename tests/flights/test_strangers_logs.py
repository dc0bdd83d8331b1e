"""Logs in the shapes in which others publish them, each made by its test."""

import json
from pathlib import Path

import numpy as np

from heli_jax.flights.describe import describe_log
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.open_log import open_log
from heli_jax.flights.time_units import likely_unit
from heli_jax.new_config import guess

RUNS = ((0, 1), (1, -1), (2, 2))
# As planners and mavlogdump write it: ids of units as numbers, counts of instances, hundredths as
# what they mean, and the last line of a log that was cut off.
FORMATS = """FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 203, 76, UNIT, QbZ, TimeUS,Id,Label
FMT, 202, 44, FMTU, QBNN, TimeUS,FmtType,UnitIds,MultIds
FMT, 204, 20, MULT, Qbd, TimeUS,Id,Mult
FMT, 130, 50, GPS, QeH, TimeUS,Alt,AltErr
FMT, 133, 53, IMU, QBf, TimeUS,I,GyrX
UNIT, 100, 115, s
UNIT, 100, 109, m
UNIT, 100, 69, rad/s
UNIT, 100, 35, instance
MULT, 100, 66, 0.01
MULT, 100, 70, 1E-06
FMTU, 100, 130, smm, FBB
FMTU, 100, 133, s#E, F--
"""


def test_a_text_of_dataflash_has_units_instances_and_a_torn_end(tmp_path: Path) -> None:
    lines = [FORMATS]
    for i in range(40):
        lines += [f"GPS, {1000 + 200_000 * i}, {5 + 0.01 * i:.2f}, {100 + i}\n"]
        lines += [f"IMU, {1000 + 20_000 * i}, {k}, {k + 0.1 * i:.3f}\n" for k in (0, 1)]
    path = tmp_path / "flight.log"
    path.write_text("".join([*lines, "IMU, 430, 0, 0\n"]))
    log = open_log(path)
    assert isinstance(log, ChannelLog)
    topics = {t.name: t for t in log.topics}
    # A height that is stored in hundredths is in metres, a count of them in centimetres.
    assert topics["GPS"].units["GPS.Alt"] == "m"
    assert topics["GPS"].units["GPS.AltErr"] == "cm"
    for k in (0, 1):
        own = topics[f"IMU[{k}]"]
        assert own.units[f"IMU[{k}].GyrX"] == "rad/s"
        np.testing.assert_allclose(own.columns[f"IMU[{k}].GyrX"], k + 0.1 * np.arange(40))
        np.testing.assert_allclose(own.times, 1e-3 + 0.02 * np.arange(40))
    assert [(n.code, n.value) for n in log.notes] == [("damage.skipped", 1)]


def test_numbers_of_packets_are_no_times(tmp_path: Path) -> None:
    # Packets of several sensors are counted together, so that those of one are not one by one.
    numbers = np.cumsum(np.tile([2, 1, 2, 1, 1], 40))
    path = tmp_path / "gyro.csv"
    rows = "".join(f"{n},{np.sin(n / 9):.5f}\n" for n in numbers)
    path.write_text("Packet number,Gyroscope X (deg/s)\n" + rows)
    assert describe_log(path).time is None
    path.write_text("Millis,Gyroscope X (deg/s)\n" + rows)
    assert describe_log(path).time is not None


def test_frequencies_are_no_times(tmp_path: Path) -> None:
    rows = "".join(f"{0.1 * i:.3f},{1 / (1 + i):.5f},{-i}\n" for i in range(60))
    path = tmp_path / "response.csv"
    path.write_text("Freq (Hz),Gain,Phase\n" + rows)
    assert describe_log(path).time is None


def test_a_sample_a_second_in_microseconds_is_no_instant() -> None:
    assert likely_unit(1e6 * np.arange(27) + 37.0) == "us"
    assert likely_unit(1e6 * np.arange(5000)) == "ns"
    assert likely_unit(2e3 * np.arange(5000)) == "us"


def test_letters_of_axes_are_those_of_the_autopilot_or_of_the_body() -> None:
    ardupilot = ["RATE.RDes", "RATE.R", "RATE.PDes", "RATE.P", "RATE.Y", "ATT.Roll"]
    spelled = guess.spelled_out(ardupilot)
    assert spelled == {
        "RATE.R": "RATE.R roll rate",
        "RATE.P": "RATE.P pitch rate",
        "RATE.Y": "RATE.Y yaw rate",
    }
    assert set(guess.spelled_out(["RATE.RDes", "RATE.R", "RATE.P"])) == {"RATE.R", "RATE.P"}
    assert guess.spelled_out(["rate_p", "rate_q", "rate_r"]) == {}
    assert guess.spelled_out(["rate_p", "rate_r", "phi"]) == {}


def test_runs_in_a_list_of_json_are_arrays_each(tmp_path: Path) -> None:
    runs = [
        {"type": "noise", "u": [0.1 * i] * 20, "y": [k + j % 7 for j in range(20)]} for k, i in RUNS
    ]
    path = tmp_path / "runs.json"
    path.write_text(json.dumps({"config": {"motors": 1, "limits": [-0.6, 0.6]}, "data": runs}))
    info = describe_log(path)
    # Limits of the joint increase, and are no clock.
    assert info.time is None
    columns = {c.name: c for c in info.columns}
    assert {f"data[{k}].{n}" for k, _ in RUNS for n in "uy"} <= set(columns)
    assert (columns["data[2].y"].rows, columns["data[2].y"].min) == (20, 2.0)
    # Records of samples that hold a short list each stay a table.
    samples = [{"t": 0.1 * i, "motor": [i, 2 * i], "gyro": [0, i]} for i in range(30)]
    path.write_text(json.dumps(samples))
    info = describe_log(path)
    assert [c.name for c in info.columns] == ["t", "motor[0]", "motor[1]", "gyro[0]", "gyro[1]"]
