"""ULog and DataFlash: values as written, equal to pyulog's and pymavlink's."""

import itertools
import math
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import Signal, read_flight
from heli_jax.flights.open_log import open_flights, open_log, open_table

from . import log_writers as writers

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
ULOG, BIN = DATA / "ulog" / "sample_log_small.ulg", DATA / "dataflash" / "test.BIN"
ABSENT = "the real logs are not at ../shared/data"

GYRO = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), ("float[3]", "xyz")]
STICK = [("uint64_t", "timestamp"), ("float", "x"), ("uint8_t[2]", "_padding0")]
T0 = 10_000_000
GYRO_ROWS = [
    (T0 + 4000 + 2500 * i, T0 + 2500 * i, math.sin(i / 20), i / 100, -1.0) for i in range(400)
]
STICK_ROWS = [(T0 + 20_000 * i, math.cos(i / 5), 0, 0) for i in range(50)]
SECOND = [(T0 + 2500 * i + 7, T0 + 2500 * i, 2.0, 0.0, 1.0) for i in range(30)]
TOPICS = [
    ("vehicle_angular_velocity", 0, GYRO, GYRO_ROWS),
    ("vehicle_angular_velocity", 1, GYRO, SECOND),
    ("manual_control_setpoint", 0, STICK, STICK_ROWS),
]
SETTINGS = {"parameters": [("IMU_GYRO_CUTOFF", 40.0), ("SYS_HITL", 0)]}
SETTINGS |= {"information": [("sys_name", "PX4"), ("ver_hw", "BOARD")]}

MESSAGES = {
    "FMTU": (200, "QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
    "UNIT": (201, "QbZ", "TimeUS,Id,Label"),
    "MULT": (202, "Qbd", "TimeUS,Id,Mult"),
    "PARM": (203, "QNf", "TimeUS,Name,Value"),
    "MSG": (204, "QZ", "TimeUS,Message"),
    "ATT": (210, "QcCf", "TimeUS,Roll,Yaw,Err"),
    "IMU": (211, "QBf", "TimeUS,I,GyrX"),
    "GPS": (212, "QBL", "TimeUS,I,Lat"),
}
ROWS = [
    ("UNIT", (0, ord("s"), b"s")),
    ("UNIT", (0, ord("d"), b"deg")),
    ("UNIT", (0, ord("E"), b"rad/s")),
    ("UNIT", (0, ord("#"), b"instance")),
    ("MULT", (0, ord("F"), 1e-6)),
    ("FMTU", (0, 210, b"sdd-", b"FBB-")),
    ("FMTU", (0, 211, b"s#E", b"F--")),
    ("PARM", (0, b"INS_GYRO_FILTER", 20.0)),
    ("MSG", (0, b"ArduCopter V4.5.1 (heli)")),
    *(("ATT", (1_000_000 + 40_000 * i, -100 * i, 36000 - i, 0.5 * i)) for i in range(30)),
    *(("IMU", (1_000_000 + 20_000 * i, k, i + k / 2)) for i in range(60) for k in (0, 1)),
    *(("GPS", (1_000_000 + 200_000 * i, 0, 473_000_000 + i)) for i in range(6)),
]


def written(tmp_path, data, name):
    path = tmp_path / name
    path.write_bytes(data)
    return path


def some_ulog(tmp_path, name="flight.ulg", **changes):
    return written(tmp_path, writers.ulog(TOPICS, **(SETTINGS | changes)), name)


def test_a_ulog_comes_back(tmp_path):
    log = open_log(some_ulog(tmp_path, dropouts=[120, 30]))
    assert (log.format, log.firmware) == ("ulog", "PX4 BOARD")
    assert log.parameters == {"IMU_GYRO_CUTOFF": 40.0, "SYS_HITL": 0}
    assert [(n.code, n.value) for n in log.notes] == [("damage.dropouts", 0.15)]
    # Two instances are separate, and the time is that of the sample, not of its publication.
    times, p = log.channel("vehicle_angular_velocity[0].xyz[0]")
    np.testing.assert_array_equal(times, [1e-6 * row[1] for row in GYRO_ROWS])
    np.testing.assert_array_equal(p, np.float32([row[2] for row in GYRO_ROWS]).astype(float))
    assert log.channel("vehicle_angular_velocity[1].xyz[0]").values.tolist() == [2.0] * 30
    times, _ = log.channel("manual_control_setpoint.x")
    np.testing.assert_array_equal(times, [1e-6 * row[0] for row in STICK_ROWS])
    assert log.topic_of("manual_control_setpoint.x").clock == "timestamp"
    assert "manual_control_setpoint._padding0[0]" not in log.names


def test_channels_of_a_ulog_become_a_flight(tmp_path):
    path = some_ulog(tmp_path)
    signals = {
        "inputs": {"stick": Signal("manual_control_setpoint.x", "1", "1")},
        "outputs": {"p": Signal("vehicle_angular_velocity[0].xyz[0]", "rad/s", "rad/s")},
    }
    flight = read_flight(path, **signals, rate=100.0)
    # Each by its own clock: at 100 Hz every fourth gyro sample, the stick interpolated between its
    # 50 Hz samples.
    np.testing.assert_allclose(flight.outputs["p"], np.sin(np.arange(99) * 4 / 20), atol=2e-2)
    at = np.arange(99) / 100
    wanted = np.interp(at, np.arange(50) / 50, np.cos(np.arange(50) / 5))
    np.testing.assert_allclose(flight.inputs["stick"][:99], wanted, atol=1e-6)
    assert flight.t0 == pytest.approx(10.0)
    with pytest.raises(InputError):
        read_flight(path, **signals)
    with pytest.raises(InputError):
        read_flight(path, time="t", **signals, rate=100.0)
    wrong = {"outputs": {"p": Signal("vehicle_angular_velocity[0].xyz[9]", "rad/s", "rad/s")}}
    with pytest.raises(InputError):
        read_flight(path, **(signals | wrong), rate=100.0)


def test_a_dataflash_log_comes_back(tmp_path):
    path = written(tmp_path, writers.dataflash(MESSAGES, ROWS), "00000012.BIN")
    log = open_log(path)
    assert (log.format, log.notes) == ("dataflash", ())
    assert log.firmware == "ArduCopter V4.5.1 (heli)"
    assert log.parameters == {"INS_GYRO_FILTER": 20.0}
    times, roll = log.channel("ATT.Roll")
    np.testing.assert_array_equal(times, [1e-6 * (1_000_000 + 40_000 * i) for i in range(30)])
    np.testing.assert_array_equal(roll, [-100 * i * 0.01 for i in range(30)])
    assert log.channel("ATT.Yaw").values[1] == 35999 * 0.01
    assert log.channel("GPS.Lat").values[1] == 473_000_001 * 1e-7
    # If the log states the instance field, each instance is a topic.
    np.testing.assert_array_equal(log.channel("IMU[1].GyrX").values, np.arange(60) + 0.5)
    units = {t.name: t.units for t in log.topics}
    assert units["ATT"]["ATT.Roll"] == "deg"
    assert units["IMU[0]"]["IMU[0].GyrX"] == "rad/s"


def test_a_dataflash_log_as_text(tmp_path):
    messages = {"ATT": (210, "Qcf", "TimeUS,Roll,Err"), "MSG": (204, "QZ", "TimeUS,Message")}
    rows = [("ATT", (1_000_000 + 40_000 * i, -0.5 * i, 0.25)) for i in range(20)]
    rows.append(("MSG", (0, "ArduCopter V4.5.1, with a comma")))
    log = open_log(written(tmp_path, writers.dataflash_text(messages, rows), "12.log"))
    # Text has centidegrees as degrees.
    np.testing.assert_array_equal(log.channel("ATT.Roll").values, [-0.5 * i for i in range(20)])
    assert log.channel("ATT.Roll").times[-1] == 1e-6 * 1_760_000
    assert log.firmware == "ArduCopter V4.5.1, with a comma"


RATE_ROWS = [(1000 * i, 10.0 + i, 5.0 + i, 0.1 * i) for i in range(60)]


@pytest.mark.parametrize("writer", [writers.dataflash, writers.dataflash_text])
def test_a_new_description_holds_from_where_it_stands(tmp_path, writer):
    # Three boots: columns in another order and hundredths, then the first layout, then one more
    # column.
    boots = [
        {"RATE": (1, "Qfff", "TimeUS,RDes,R,ROut")},
        {"RATE": (1, "Qfcf", "TimeUS,ROut,R,RDes"), "ACC": (2, "Qf", "TimeUS,X")},
        {"RATE": (1, "Qfff", "TimeUS,RDes,R,ROut"), "ACC": (3, "Qf", "TimeUS,X")},
        {"RATE": (1, "Qffff", "TimeUS,RDes,R,ROut,Y")},
    ]
    is_text = writer is writers.dataflash_text
    data = b""
    for k, boot in enumerate(boots):
        rows = []
        for t, des, r, out in RATE_ROWS[15 * k : 15 * k + 15]:
            stored = r if is_text or k != 1 else round(100 * r)
            row = [t, out, stored, des] if k == 1 else [t, des, r, out, *[1.5] * (k == 3)]
            rows.append(("RATE", row))
            rows += [("ACC", (t, 2.0 * r))] if "ACC" in boot else []
        data += writer(boot, rows)
    log = open_log(written(tmp_path, data, "anew.log" if is_text else "anew.bin"))
    for column, at in (("RDes", 1), ("R", 2), ("ROut", 3)):
        times, values = log.channel(f"RATE.{column}")
        np.testing.assert_allclose(values, [row[at] for row in RATE_ROWS], rtol=1e-6)
        np.testing.assert_allclose(times, [1e-6 * row[0] for row in RATE_ROWS])
    added = log.channel("RATE.Y").values
    np.testing.assert_array_equal(added, [np.nan] * 45 + [1.5] * 15)
    # One name has two numbers, which is not damage.
    np.testing.assert_allclose(
        log.channel("ACC.X").values, [2 * row[2] for row in RATE_ROWS[15:45]]
    )
    assert log.notes == ()


def test_a_new_unit_makes_another_topic(tmp_path):
    described = dict(list(MESSAGES.items())[:3])
    boots = [(b"d", "ATT"), (b"r", "ATT"), (b"d", "ATT")]
    data = b""
    for k, (mark, name) in enumerate(boots):
        rows = [("UNIT", (0, ord(m), label)) for m, label in (("d", b"deg"), ("r", b"rad"))]
        rows.append(("FMTU", (0, 210 + k, b"s" + mark, b"F-")))
        rows += [(name, (1000 * (20 * k + i), float(k))) for i in range(20)]
        data += writers.dataflash(described | {name: (210 + k, "Qf", "TimeUS,Roll")}, rows)
    log = open_log(written(tmp_path, data, "units.bin"))
    first, second = (log.topic_of(f"{name}.Roll") for name in ("ATT", "ATT#2"))
    np.testing.assert_array_equal(first.columns["ATT.Roll"], [0.0] * 20 + [2.0] * 20)
    np.testing.assert_array_equal(second.columns["ATT#2.Roll"], [1.0] * 20)
    assert first.units["ATT.Roll"] == "deg"
    assert second.units["ATT#2.Roll"] == "rad"


@pytest.mark.parametrize("writer", [writers.dataflash, writers.dataflash_text])
@pytest.mark.parametrize("board", [True, False])
def test_a_time_of_week_is_not_the_boards_clock(tmp_path, writer, board):
    # ArduCopter before 3.3: TimeMS is the board's clock except in GPS, where T is.
    end = ("IHfI", "TimeMS,Week,Spd,T") if board else ("IHf", "TimeMS,Week,Spd")
    messages = {"IMU": (2, "If", "TimeMS,GyrX"), "GPS": (3, *end)}
    rows = [("IMU", (50_000 + 20 * i, 0.5 * i)) for i in range(300)]
    rows += [
        ("GPS", (6_250_000 + 200 * i, 1815, 1.0 * i, *[50_003 + 200 * i] * board))
        for i in range(30)
    ]
    log = open_log(written(tmp_path, writer(messages, rows), "week.log"))
    if board:
        np.testing.assert_allclose(log.channel("GPS.Spd").times, 50.003 + 0.2 * np.arange(30))
    else:
        # The relation of the two clocks is unknown.
        assert log.topic_of("GPS.Spd").clock == ""
    assert log.channel("IMU.GyrX").times[-1] == pytest.approx(55.98)


def test_old_text_has_only_an_order(tmp_path):
    messages = {"ATT": (1, "ccC", "RollIn,Roll,Yaw")}
    rows = [("ATT", (0.0, i / 2, 3.0)) for i in range(20)]
    path = written(tmp_path, writers.dataflash_text(messages, rows), "old.log")
    log = open_log(path)
    assert log.topics[0].columns["ATT.Roll"].tolist() == [i / 2 for i in range(20)]
    signals = {"inputs": {}, "outputs": {"roll": Signal("ATT.Roll", "deg", "rad")}}
    with pytest.raises(InputError):
        read_flight(path, **signals)


def test_a_format_is_known_by_its_content_too(tmp_path):
    assert open_log(some_ulog(tmp_path, "download.txt")).format == "ulog"
    data = writers.dataflash(MESSAGES, ROWS)
    assert open_log(written(tmp_path, data, "flight.log")).format == "dataflash"
    with pytest.raises(InputError):
        open_table(some_ulog(tmp_path))
    with pytest.raises(InputError):
        open_log(written(tmp_path, b"t,x\n0,1\n1,2\n", "bench.csv"), 2)


def test_damage_is_counted(tmp_path):
    data = bytearray(writers.dataflash(MESSAGES, ROWS))
    at = data.index(b"\xa3\x95" + bytes([210]), 1000)
    data[at : at + 2] = b"\0\0"
    log = open_log(written(tmp_path, bytes(data), "cut.bin"))
    assert [(n.code, n.value) for n in log.notes] == [("damage.skipped", 1)]
    assert log.channel("ATT.Roll").values.size == 29


ZEROS = bytes(512)
ONE = [("uint64_t", "timestamp"), ("float", "x")]
END = b"\xff" * 3
LATE = 867_798_000_000_000_000


def rows_of(tmp_path, data, name="damaged.ulg"):
    log = open_log(written(tmp_path, data, name))
    return {t.name: t.times.size for t in log.topics}, log


def test_damage_in_a_ulog_is_noted(tmp_path):
    whole = writers.ulog([("a", 0, ONE, [(T0 + 4000 * i, i) for i in range(600)])])
    at = whole.index(b"D", 3000) - 2
    rows, log = rows_of(tmp_path, whole[:at] + ZEROS + whole[at:])
    assert rows == {"a": 600}
    np.testing.assert_array_equal(log.channel("a.x").values, np.arange(600))
    assert len(log.notes) == 1
    # 31 bytes are missing within the rows.
    rows, log = rows_of(tmp_path, whole[: at + 5] + whole[at + 36 :])
    assert 0 < rows["a"] < 600
    assert set(log.channel("a.x").values) <= set(range(600))
    assert [n.code for n in log.notes] == ["damage.skipped"]
    assert log.notes[0].value < 50


@pytest.mark.parametrize("place", [0, 300, 599])
def test_a_row_with_a_stamp_of_another_age_is_damage(tmp_path, place):
    stamps = [T0 + 4000 * i for i in range(600)]
    stamps[place] = LATE
    rows, log = rows_of(tmp_path, writers.ulog([("a", 0, ONE, [(t, 1.0) for t in stamps])]))
    assert rows == {"a": 599}
    assert log.topics[0].times[-1] - log.topics[0].times[0] < 3
    assert len(log.notes) == 1


def test_types_and_flags_that_never_end_are_damage(tmp_path):
    def message(kind, body):
        return struct.pack("<HB", len(body), ord(kind)) + body

    head = writers.ulog([])
    chain = [message("F", f"{x}:{y} n[99999];".encode()) for x, y in itertools.pairwise("abcdefgh")]
    nested = b"".join([*chain, message("F", b"h:"), message("A", struct.pack("<BH", 0, 0) + b"a")])
    fields = "".join(f"uint8_t {i:04x}a;".replace(" ", " x") for i in range(4600))
    wide = message(
        "F", b"w:uint64_t timestamp;" + fields.encode()[:64000].rpartition(b";")[0] + b";"
    )
    many = wide + b"".join(message("A", struct.pack("<BH", 0, i) + b"w") for i in range(4000))
    flags = b"".join(
        message("B", bytes(8) + b"\1" + bytes(7) + struct.pack("<3Q", 61 + 46 * i, 0, 0))
        + b"\xff" * 3
        for i in range(1, 1000)
    )
    for data in (head + nested, head + many, head[:16] + flags):
        begin = time.process_time()
        with pytest.raises(InputError):
            open_log(written(tmp_path, data, "endless.ulg"))
        assert time.process_time() - begin < 8


def test_names_that_a_terminal_would_obey(tmp_path):
    hostile = dict(MESSAGES) | {"ATT": (210, "Qcf", "TimeUS,\x1b[2J,Err")}
    rows = [row for row in ROWS if row[0] != "ATT"]
    log = open_log(written(tmp_path, writers.dataflash(hostile, rows), "h.bin"))
    assert not any("\x1b" in name for name in log.names)
    assert log.notes[0].code == "damage.skipped"


@pytest.mark.skipif(not ULOG.exists(), reason=ABSENT)
def test_the_numbers_are_pyulogs():
    pyulog = pytest.importorskip("pyulog", reason="pyulog is not installed")
    (log,) = open_flights(ULOG)
    theirs = pyulog.ULog(str(ULOG))
    assert theirs.start_timestamp == round(log.start * 1e6)
    assert theirs.initial_parameters == log.parameters
    several = {d.name for d in theirs.data_list if d.multi_id}
    names = set()
    for data in theirs.data_list:
        topic = f"{data.name}[{data.multi_id}]" if data.name in several else data.name
        for field, values in data.data.items():
            if "_padding" in field:  # bytes between the fields, which are not a signal
                continue
            names.add(f"{topic}.{field}")
            np.testing.assert_array_equal(log.channel(f"{topic}.{field}").values, values)
    assert names == set(log.names)


@pytest.mark.skipif(not BIN.exists(), reason=ABSENT)
def test_the_numbers_are_pymavlinks():
    reader = pytest.importorskip("pymavlink.DFReader", reason="pymavlink is not installed")
    (log,) = open_flights(BIN)
    theirs, rows = reader.DFReader_binary(str(BIN)), {}
    while (message := theirs.recv_msg()) is not None:
        rows.setdefault(message.get_type(), []).append(message.to_dict())
    theirs.data_map.close()
    theirs.filehandle.close()
    for topic in log.topics:
        for name, values in topic.columns.items():
            field = name.removeprefix(f"{topic.name}.")
            wanted = [row[field] for row in rows[topic.name]]
            np.testing.assert_array_equal(values, wanted, err_msg=name)
