"""Logs in published layouts, each made by its test."""

from pathlib import Path

import numpy as np

from heli_jax.flights.log import ChannelLog
from heli_jax.flights.open_log import open_log
from heli_jax.new_config import guess

RUNS = ((0, 1), (1, -1), (2, 2))
# As written by planners and mavlogdump: unit ids as numbers, instance counts, scaled hundredths,
# and a truncated last line.
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
    path.write_text("".join([*lines, "IMU, 430, 0, 0"]))
    log = open_log(path)
    assert isinstance(log, ChannelLog)
    topics = {t.name: t for t in log.topics}
    # A height stored in hundredths is in metres, a count of them in centimetres.
    assert topics["GPS"].units["GPS.Alt"] == "m"
    assert topics["GPS"].units["GPS.AltErr"] == "cm"
    for k in (0, 1):
        own = topics[f"IMU[{k}]"]
        assert own.units[f"IMU[{k}].GyrX"] == "rad/s"
        np.testing.assert_allclose(own.columns[f"IMU[{k}].GyrX"], k + 0.1 * np.arange(40))
        np.testing.assert_allclose(own.times, 1e-3 + 0.02 * np.arange(40))
    assert [(n.code, n.value) for n in log.notes] == [("damage.skipped", 1)]


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
