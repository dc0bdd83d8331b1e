"""`heli-jax info` and `heli-jax convert` on logs of every kind."""

import json
import subprocess
import sys

import numpy as np
import pytest
import scipy.io

from heli_jax.cli import main
from heli_jax.flights import describe_log, read_flight
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.open_log import open_log

from .test_autopilot_logs import DATA, MESSAGES, ROWS, TOPICS, some_ulog, writers, written
from .test_blackbox import some_flight

ATTITUDE = "vehicle_angular_velocity"


def table_of(path):
    table = open_log(path)
    return table.numbers([n for n in table.names if n])


def refused(capsys, arguments):
    assert main([str(a) for a in arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_channels_become_a_table(tmp_path, ending, capsys):
    path, out = some_ulog(tmp_path), tmp_path / f"out.{ending}"
    signals = [f"{ATTITUDE}[[]0].xyz[0]".replace("[[]", "["), "manual_control_setpoint.*"]
    arguments = ["convert", path, out, "--signals", *signals, "--rate", "200", "--window", "0", "1"]
    assert main([str(a) for a in arguments]) == 0
    columns = table_of(out)
    times = columns["time"]
    np.testing.assert_allclose(np.diff(times), 1 / 200)
    assert times[-1] <= 1.0
    wanted = np.interp(times, np.arange(400) * 2.5e-3, np.sin(np.arange(400) / 20))
    np.testing.assert_allclose(columns[f"{ATTITUDE}[0].xyz[0]"], wanted, atol=2e-2)
    stick = np.interp(times, np.arange(50) / 50, np.cos(np.arange(50) / 5))
    np.testing.assert_allclose(columns["manual_control_setpoint.x"], stick, atol=1e-6)


def test_without_a_rate_the_samples_stay_as_they_are(tmp_path):
    path, out = some_ulog(tmp_path), tmp_path / "out.csv"
    assert main(["convert", str(path), str(out), "--signals", f"{ATTITUDE}[0].xyz*"]) == 0
    log, columns = open_log(path), table_of(out)
    for i in range(3):
        name = f"{ATTITUDE}[0].xyz[{i}]"
        times, values = log.channel(name)
        np.testing.assert_array_equal(columns[name], values)
        np.testing.assert_allclose(columns["time"], times - 10.0, atol=1e-12)


def test_what_is_missing_is_said_and_stays_empty(tmp_path, capsys):
    path, out = tmp_path / "bench.csv", tmp_path / "out.csv"
    rows = [(i, i % 7) for i in range(500) if not 200 <= i < 260]
    rows = [f"{10 * i},{'' if i == 50 else x},{i // 100}" for i, x in rows]
    path.write_text("\n".join(["t_ms,x,mode", *rows]))
    assert main(["convert", str(path), str(out), "--rate", "100"]) == 0
    # A gap of 61 steps is too long to bridge.
    columns = table_of(out)
    assert np.isnan(columns["mode"]).sum() == 60
    assert np.isnan(columns["x"][50])
    # Steps stay steps: there are no values between two modes.
    assert set(columns["mode"][~np.isnan(columns["mode"])]) == {0.0, 1.0, 2.0, 3.0, 4.0}


def test_conversions_that_are_refused(tmp_path, capsys):
    path, out = some_ulog(tmp_path), tmp_path / "out.csv"
    bench = tmp_path / "bench.csv"
    bench.write_text("t,time\n" + "\n".join(f"{i},{i}" for i in range(20)))
    for arguments in (
        [path, out],
        [path, tmp_path / "out.xlsx"],
        [path, out, "--signals", "manual_control_setpoint.y"],
        [path, out, "--rate", "-1"],
        [path, out, "--window", "5", "1"],
        [path, out, "--window", "50", "51"],
        [path, out, "--time", "t"],
        [bench, bench],
        [bench, out, "--time", "t"],
        [bench, out, "--time-unit", "foo"],
        [bench, out, "--time-unit", "deg"],
        [path, out, "--signals", "ccpm.roll"],
        [path, out, "--signals", "euler(ATT.Roll)"],
        [path, out, "--preset", "px4"],
        [path, out, "--preset", "ardupilot-helicopter"],
        [path, out, "--preset", "px4-helicopter", "--signals", "manual*"],
    ):
        refused(capsys, ["convert", *arguments])
    assert not out.exists()


def test_a_flight_of_several_is_converted_and_fitted_alike(tmp_path, capsys):
    path, out = tmp_path / "LOG.TXT", tmp_path / "out.parquet"
    path.write_bytes(some_flight() + some_flight())
    refused(capsys, ["convert", path, out, "--rate", "100"])
    arguments = ["convert", str(path), str(out), "--rate", "100", "--flight", "2"]
    assert main([*arguments, "--signals", "gyroADC*", "motor"]) == 0
    converted = convert_log(path, Selection(["gyroADC[1]"], 100.0, flight=2))
    columns = table_of(out)
    np.testing.assert_array_equal(columns["gyroADC[1]"], converted.columns["gyroADC[1]"])
    from heli_jax.flights import Signal

    flight = read_flight(
        path,
        inputs={},
        outputs={"p": Signal("gyroADC[1]", "1", "1")},
        number=2,
        rate=100.0,
    )
    np.testing.assert_allclose(flight.outputs["p"], columns["gyroADC[1]"], rtol=1e-12)


def logs(tmp_path):
    (tmp_path / "two.bbl").write_bytes(some_flight(settings=[("gyro_lpf1_static_hz", "150")]) * 2)
    some_ulog(tmp_path)
    written(tmp_path, writers.dataflash(MESSAGES, ROWS), "1.bin")
    (tmp_path / "bench.csv").write_text("t,x\n" + "\n".join(f"{i / 50},{i}" for i in range(99)))
    return ["two.bbl", "flight.ulg", "1.bin", "bench.csv"]


def test_info_of_every_kind_of_log(tmp_path, capsys, monkeypatch):
    names = logs(tmp_path)
    monkeypatch.chdir(tmp_path)
    for name in names:
        assert main(["info", name]) == 0
        assert capsys.readouterr().out


def test_info_as_json(tmp_path, capsys):
    for name in logs(tmp_path):
        assert main(["info", str(tmp_path / name), "--json"]) == 0
        content = json.loads(capsys.readouterr().out)
        assert content["sha256"] == open_log(tmp_path / name, 1).sha256
        flights = content["flights"]
        assert len(flights) == (2 if name == "two.bbl" else 1)
        topic = flights[-1]["topics"][0]
        assert topic["time"]["rate"] > 1
        assert {"name", "unit", "min", "max", "nan_share"} <= topic["channels"][0].keys()
    assert main(["info", str(tmp_path / "two.bbl"), "--json", "--flight", "2"]) == 0
    flights = json.loads(capsys.readouterr().out)["flights"]
    assert [flight["number"] for flight in flights] == [2]
    assert flights[0]["filters"] == {"gyro_lpf1_static_hz": "150"}


@pytest.mark.parametrize(
    ("step", "unit", "rate"), [(0.02, "s", 50), (20, "ms", 50), (2000, "us", 500), (2e6, "ns", 500)]
)
def test_the_unit_of_stamps_is_guessed_and_settable(tmp_path, step, unit, rate):
    path = tmp_path / "bench.csv"
    path.write_text("t,x\n" + "\n".join(f"{step * i:.10g},{i}" for i in range(200)))
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.unit, info.time.guessed) == (unit, True)
    assert info.time.rate == pytest.approx(rate)
    stated = describe_log(path, unit="s").time
    assert stated is not None
    assert (stated.rate, stated.guessed) == (pytest.approx(1 / step), False)


def test_hostile_names_do_no_harm(tmp_path, capsys):
    path = tmp_path / "h.csv"
    path.write_text("t,\x1b[31mred\x07,[bold]x\n" + "\n".join(f"{i},1,2" for i in range(9)))
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "\x1b" not in shown
    assert "\x07" not in shown
    assert "[bold]x" in shown


@pytest.mark.skipif(not DATA.exists(), reason="the real logs are not at ../shared/data")
@pytest.mark.parametrize(
    "name", ["rotorflight/LOG246.TXT", "ulog/sample_log_small.ulg", "dataflash/test.BIN"]
)
def test_info_goes_without_jax(name):
    program = (
        "import sys\nfrom heli_jax.cli import main\n"
        f"main(['info', {str(DATA / name)!r}])\n"
        "assert not {'jax', 'pandas', 'scipy', 'matplotlib'} & {*sys.modules}\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert run.returncode == 0, run.stderr


def test_topics_are_told_apart_in_a_conversion_of_all(tmp_path):
    path = some_ulog(tmp_path)
    converted = convert_log(path, Selection(rate=50.0))
    # The second gyro logged 0.07 s of one second; it is left out, so that the others are not cut to
    # it.
    assert not any(name.startswith(f"{ATTITUDE}[1]") for name in converted.columns)
    assert "channels.left-out" in {n.code for n in converted.notes}
    assert converted.columns["time"].size == 50
    assert TOPICS[0][0] == ATTITUDE


def test_nothing_is_overwritten(tmp_path, capsys):
    path, out = some_ulog(tmp_path), tmp_path / "out.csv"
    arguments = ["convert", path, out, "--signals", f"{ATTITUDE}[0].xyz*", "--window", "0", "40"]
    assert main([str(a) for a in arguments]) == 0
    before = out.read_bytes()
    capsys.readouterr()
    refused(capsys, arguments)
    assert out.read_bytes() == before


def arrays(path, **gps):
    log = {"t": np.arange(100) * 0.01, "p": np.sin(np.arange(100)), "gps": gps}
    scipy.io.savemat(path, {"log": log})
    return path


def test_arrays_of_another_length(tmp_path, capsys):
    alone = arrays(tmp_path / "alone.mat", v=np.cos(np.arange(20)))
    assert [n.value for n in describe_log(alone).notes if n.code == "channels.other-length"] == [20]
    refused(capsys, ["convert", alone, tmp_path / "no.csv", "--signals", "log.gps.v"])
    left = [n.subjects for n in convert_log(alone, Selection()).notes]
    assert ("log.gps.v",) in left
    times = 0.3 + np.arange(20) * 0.02
    both = arrays(tmp_path / "both.mat", v=np.cos(np.arange(20)), time=times)
    columns = convert_log(both, Selection(["log.gps.v"])).columns
    np.testing.assert_allclose(columns["time"], times, atol=1e-12)
    np.testing.assert_array_equal(columns["log.gps.v"], np.cos(np.arange(20)))


def test_an_autopilots_log_under_the_name_of_a_table(tmp_path):
    path = some_ulog(tmp_path)
    assert open_log(path.rename(tmp_path / "flight.csv")).format == "ulog"
    assert open_log(written(tmp_path, some_flight(), "other.csv")).format == "blackbox"
    text = written(tmp_path, b"ULog,t\n0,1\n1,2\n", "table.csv")
    assert open_log(text).names == ("ULog", "t")


def test_the_share_that_is_missing_is_of_all_rows(tmp_path, capsys):
    path = tmp_path / "log.csv"
    rows = [f"{0.1 * k:.1f},{k if k % 2 else ''},{'' if k % 4 else k}," for k in range(100)]
    path.write_text("\n".join(["t,half,quarter,none", *rows]) + "\n")
    assert main(["info", str(path), "--json"]) == 0
    [flight] = json.loads(capsys.readouterr().out)["flights"]
    shares = {c["name"]: c["nan_share"] for c in flight["topics"][0]["channels"]}
    assert shares == {"t": 0.0, "half": 0.5, "quarter": 0.75, "none": 1.0}
