"""`heli-jax new`: guesses for logs with known channels, and the resulting files."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import cli, load_config, units, yaml_file
from heli_jax.config import read_flights
from heli_jax.config.problems import problem
from heli_jax.config.schema import Config
from heli_jax.errors import InputError
from heli_jax.flights.log import ChannelLog, Topic
from heli_jax.new_config import tables, write_config
from heli_jax.new_config.guess import (
    Series,
    by_name,
    by_number,
    may_be,
    without_unit,
    words_of,
)
from heli_jax.new_config.model_choice import vehicle_of
from heli_jax.new_config.rate import channels_of_preset, common_rate
from heli_jax.new_config.scales import scaled
from heli_jax.new_config.signals import is_place
from tests.flights.log_writers import ulog

T = np.arange(0.0, 20.0, 0.02)
STICK = np.where(T < 1.0, 0.0, 0.4 * np.sign(np.sin(1.3 * T)))
RATE = np.convolve(STICK, np.exp(-T / 0.2) * 0.1)[: T.size]


def write(path: Path, columns: dict[str, np.ndarray]) -> Path:
    rows = np.column_stack(list(columns.values()))
    lines = [",".join(columns), *(",".join(f"{x:.10g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def table(rate: str = "roll_rate_dps", stick: str = "aileron_pwm") -> dict[str, np.ndarray]:
    noise = 0.01 * np.random.default_rng(0).standard_normal(T.size)
    return {
        "time_ms": 1e3 * T + 5e5,
        stick: 1496.0 + 400.0 * STICK,
        rate: np.degrees(RATE + noise),
        "battery": 12.4 - 0.01 * T,
    }


def test_a_stick_in_pulse_widths_beside_a_rate_becomes_a_configuration_that_reads(
    tmp_path: Path,
) -> None:
    log, out = write(tmp_path / "run.csv", table()), tmp_path / "run.yaml"
    assert cli.main(["new", str(log), "--out", str(out)]) == 0
    # A stand or a flybar has the same signals, so the other models are listed.
    assert "#   roll-on-stand: " in out.read_text()
    made = Config.model_validate(yaml_file.read_mapping(out))
    signals = made.flights[0].signals
    assert made.flights[0].log == "run.csv"
    assert signals.time is not None
    assert (signals.time.signal, signals.time.unit) == ("time_ms", "ms")
    lat = signals.inputs["lat"]
    assert (lat.signal, lat.unit, lat.offset, lat.scale) == ("aileron_pwm", "1", 1496.0, 0.002)
    assert {n: (o.signal, o.unit) for n, o in signals.outputs.items()} == {
        "p": ("roll_rate_dps", "deg/s")
    }
    # An existing file is not replaced.
    before = out.read_text()
    assert cli.main(["new", str(log), "--out", str(out)]) == 2
    assert out.read_text() == before


def test_a_model_of_one_s_own_beside_the_configuration(tmp_path: Path) -> None:
    assert cli.main(["new-model", "pendulum", "--out", str(tmp_path / "own")]) == 0
    log, out = write(tmp_path / "run.csv", table("theta_deg")), tmp_path / "own" / "mine.yaml"
    assert cli.main(["new", str(log), "--out", str(out), "--model", "pendulum:model"]) == 0
    assert yaml_file.read_mapping(out)["model"] == "pendulum:model"


def test_what_only_the_user_knows_is_refused_until_it_is_given(tmp_path: Path) -> None:
    columns = table("roll_deg") | {"rpm": np.full(T.size, 1450.0)}
    log, out = write(tmp_path / "run.csv", columns), tmp_path / "mine.yaml"
    assert cli.main(["new", str(log), "--out", str(out), "--model", "roll-on-stand"]) == 0
    vehicle = yaml_file.read_mapping(tmp_path / "mine-vehicle.yaml")
    assert vehicle["Omega"]["value"] == pytest.approx(1450 * np.pi / 30, rel=1e-4)
    assert vehicle["L3"] == {"value": "EDIT", "unit": "m"}
    # A spring or damper of the stand would be fitted as another inertia.
    assert {vehicle[n]["value"] for n in ("kappa", "zeta")} == {"EDIT"}
    # The inertias are requested once, in the vehicle file, which also gives the start values.
    assert yaml_file.read_mapping(out)["fit"]["free"] == {"Ixx": {}, "If": {}}
    assert cli.main(["check", str(out)]) == 2
    bench = Path("configs/vehicles/bench-30.yaml").read_text()
    (tmp_path / "mine-vehicle.yaml").write_text(bench)
    out.write_text(out.read_text().replace("scale: EDIT", "scale: 6.0e-9"))
    free = problem(load_config(out)).free
    assert (free["Ixx"].start, free["If"].start) == (0.024, 1.7e-4)


def test_a_stick_and_an_axis_that_were_not_logged(tmp_path: Path) -> None:
    """Test a hover with only roll and pitch logged: the pedal stays, and no yaw gust is added."""
    columns = table("roll_rate_dps", "lat_cmd")
    columns |= {"lon_cmd": columns["lat_cmd"][::-1], "pitch_rate_dps": columns["roll_rate_dps"]}
    log, out = write(tmp_path / "hover.csv", columns), tmp_path / "hover.yaml"
    made = ["new", str(log), "--out", str(out), "--model", "linear:attitude-flybarless"]
    assert cli.main(made) == 0
    assert yaml_file.read_mapping(out)["disturbance"] == {"on": ["roll", "pitch"]}
    assert cli.main(["check", str(out)]) == 2
    out.write_text(out.read_text().replace("{signal: EDIT}", "{constant: 0}"))
    assert problem(load_config(out)).free
    # The file has another vehicle's numbers: they are stated as start values.
    with pytest.raises(InputError, match=r"Lb\.start: "):
        problem(load_config(out, {"fit.free": {"Lb": {}}}))


def test_a_vehicle_file_below_or_beside_is_named_relative_to_the_configuration(
    tmp_path: Path,
) -> None:
    (tmp_path / "home" / "vehicles").mkdir(parents=True)
    (tmp_path / "home" / "runs").mkdir()
    source = Path(__file__).parent.parent / "configs" / "vehicles" / "bench-30.yaml"
    vehicle = tmp_path / "home" / "vehicles" / "mine.yaml"
    vehicle.write_text(source.read_text())
    log = write(tmp_path / "run.csv", table("roll_deg"))
    named = {}
    for place in ("home/a.yaml", "home/runs/a.yaml", "a.yaml", "home/runs/b/c/a.yaml"):
        out = tmp_path / place
        out.parent.mkdir(exist_ok=True, parents=True)
        made = ["new", str(log), "--out", str(out), "--model", "roll-on-stand"]
        assert cli.main([*made, "--vehicle", str(vehicle)]) == 0
        named[place] = yaml_file.read_mapping(out)["vehicle"]
        assert (out.parent / named[place]).resolve() == vehicle.resolve()
    assert list(named.values()) == [
        "vehicles/mine.yaml",
        "../vehicles/mine.yaml",
        "home/vehicles/mine.yaml",
        str(vehicle.resolve()),
    ]


def test_topics_with_clocks_of_their_own_get_a_rate() -> None:
    fast, slow = np.arange(0.0, 5.0, 0.0024), np.arange(0.0, 5.0, 0.0402)
    gps = np.arange(0.0, 5.0, 0.2)
    series = {"gyro": Series(fast, fast), "stick": Series(slow, slow), "gps": Series(gps, gps)}
    assert common_rate(series, ["gyro"]) == 100.0
    assert common_rate(series, ["gyro", "stick"]) == 25.0
    # A slow sensor keeps its own samples; alone it determines the rate.
    assert common_rate(series, ["gyro", "stick", "gps"]) == 25.0
    assert common_rate(series, ["gps"]) == 5.0
    assert common_rate(series, []) is None
    px4 = ["vehicle_angular_velocity.xyz[0]", "actuator_controls_0.control[0]", "other.x"]
    assert channels_of_preset("px4-helicopter", px4, ["p", "phi", "lat"]) == px4[:2]


@pytest.mark.parametrize("log", ["none.csv", "text.csv", "still.csv"])
def test_a_log_that_tells_nothing_ends_in_a_sentence(
    log: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "text.csv", {"t": T, "a": STICK, "b": RATE})
    write(tmp_path / "still.csv", {"t": T, "lat_cmd": 0.0 * STICK, "p": RATE})
    assert cli.main(["new", str(tmp_path / log), "--out", str(tmp_path / "x.yaml")]) == 2
    [message] = capsys.readouterr().err.splitlines()
    # The stick that does not move is named before the list of columns.
    assert ("lat_cmd" in message.split("(")[0]) is (log == "still.csv")
    assert not (tmp_path / "x.yaml").exists()


def test_names_of_a_log_cannot_leave_their_place(tmp_path: Path) -> None:
    hostile = 'lat"}, fit: {x'
    columns = {"t": T, hostile.replace(",", ";"): STICK, "p": RATE, "#a: b": RATE}
    log, out = write(tmp_path / "run.csv", columns), tmp_path / "run.yaml"
    assert cli.main(["new", str(log), "--out", str(out), "--model", "roll-flybarless"]) == 0
    made = Config.model_validate(yaml_file.read_mapping(out))
    assert made.flights[0].signals.outputs["p"].signal == "p"


@pytest.mark.parametrize("mark", ["\x1b[2J", "\x7f", "\x9b", "\u202e", "\ufeff", "\U000e0001", "é"])
def test_what_a_name_holds_is_read_back(
    tmp_path: Path, mark: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write(tmp_path / f"run{mark}.csv", table(stick=f"aileron{mark} pwm"))
    out = tmp_path / "run.yaml"
    assert cli.main(["new", str(log), "--out", str(out), "--model", "roll-flybarless"]) == 0
    made = Config.model_validate(yaml_file.read_mapping(out))
    assert made.flights[0].log == log.name
    printed = "".join(capsys.readouterr())
    assert all(c.isprintable() for line in printed.split("\n") for c in line)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gyro.x", ("gyro", "x")),
        ("rollRate [deg/s]", ("roll", "rate")),
        ("Roll (deg)", ("roll",)),
        ("log.roll_rad", ("log", "roll")),
        ("p", ("p",)),
        ("q_dps_meas", ("q", "meas")),
        ("RollAngleDeg", ("roll", "angle")),
        ("gyro_x_rad_s", ("gyro", "x")),
        ("rollDegree", ("roll", "degree")),
    ],
)
def test_the_words_of_a_name_are_without_its_unit(name: str, words: tuple[str, ...]) -> None:
    assert words_of(name) == words


def test_a_whole_name_goes_before_one_that_holds_it_and_commands_are_no_measurements() -> None:
    names = ["roll_setpoint", "log.roll", "roll", "roll_sp", "rolling"]
    assert by_name(["phi", "roll"], names) == ["roll", "log.roll"]


# One name per field; in other formats a name with blanks is quoted.
CALLED = {
    ("outputs", "roll_rate"): "RollRate gyroX wx omega_x p_meas phi_dot gyroADC[0] p_radps imu_gx "
    "AngVelX /orientation/roll-rate-degps gx_dps RollRate_degPerSec roll_rate_deg_sec_filt wx.raw "
    "rollspeed",
    ("outputs", "pitch_rate"): "PitchRate q_dps_meas rates.y GyroY_radps gyroUnfilt[1] ang_vel_y "
    "____Q,_deg/s Nickrate Nickrate_grad_s",
    ("outputs", "yaw_rate"): "gier_rate",
    ("outputs", "roll"): "rollDeg phi_meas_deg RollAngle_rad Rollwinkel_Grad roll_cdeg",
    ("outputs", "pitch"): "Nickwinkel_deg nick assiette[deg]",
    ("outputs", "yaw"): "Gierwinkel",
    ("outputs", "climb"): "climb_rate_cms",
    ("outputs", "down_speed"): "vel_d_m_s",
    ("inputs", "roll"): "Roll_Cmd swashRollCmd roll_cmd_deg aileron_cmd cmdRoll ail_us Ail "
    "rcCommand[0] ch1_aileron_us ailrn,_yok1 Querruder[%]",
    ("inputs", "pitch"): "elevatorCmd pitch_command delta_e rcCommand[1] Höhenruder",
    ("inputs", "yaw"): "rcCommand[2] Rud Seitenruder",
    ("inputs", "collective"): "Pas_général",
    ("numbered", "roll"): "chan1_raw rc[0]",
    ("numbered", "pitch"): "servoRaw.servo2 Kanal2_us",
    ("numbered", "collective"): "rcin_3",
    ("numbered", "yaw"): "RC_Channel_4",
    ("numbered", ""): "chan12_raw ch",
}


@pytest.mark.parametrize(("kind", "signal"), CALLED)
def test_names_as_people_and_autopilots_write_them(kind: str, signal: str) -> None:
    names = tables.names()
    for name in CALLED[kind, signal].split():
        found = [
            k
            for k, words in names[kind].items()
            if (
                by_number(words, [name])
                if kind == "numbered"
                else by_name(words, [name], names["commands"][k] if kind == "inputs" else ())
            )
        ]
        assert found == [signal] * bool(signal), name


def test_a_stick_goes_before_what_is_commanded_by_it() -> None:
    names = tables.names()["inputs"]["roll"]
    assert by_name(names, ["roll_cmd", "aileron"], ["roll"])[0] == "aileron"


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *(("roll_rate_dps", "deg/s"), ("p_radps", "rad/s"), ("roll-rate-degps", "deg/s")),
        *(("RollRate_degPerSec", "deg/s"), ("p deg per second", "deg/s"), ("vel_d_m_s", "m/s")),
        *(("p_dot_rad_s2", "rad/s^2"), ("Climb ft/sec", "ft/s"), ("roll_cdeg", "cdeg")),
        *(("roll_cd", "cdeg"), ("p_cds", "cdeg/s"), ("gyro_mrads", "mrad/s")),
        *(("climb_rate_cms", "cm/s"), ("climb_cm_s", "cm/s"), ("roll_rate_mrad_s", "mrad/s")),
    ],
)
def test_the_unit_at_the_end_of_a_name(name: str, unit: str) -> None:
    assert without_unit(name)[1] == unit
    assert units.is_unit(unit)


@pytest.mark.parametrize(
    ("values", "si", "unit", "scale"),
    [
        (np.linspace(-40, 40, 50), "rad", "deg", 1.0),
        (np.linspace(-0.6, 0.6, 50), "rad", "rad", 1.0),
        (np.linspace(-200, 200, 50), "rad/s", "deg/s", 1.0),
        (np.linspace(-80, 95, 50), "1", "%", 1.0),
        (np.linspace(-900, 950, 50), "1", "1", 0.001),
        (np.linspace(-0.9, 0.95, 50), "1", "1", 1.0),
        (np.linspace(-0.9, 0.95, 50), "m", "m", "EDIT"),
    ],
)
def test_units_by_the_size_of_numbers(
    values: np.ndarray, si: str, unit: str, scale: float | str
) -> None:
    found = scaled("x", Series(np.arange(50.0), values), si)
    assert (found.unit, found.scale) == (unit, scale)
    assert any(r.startswith("GUESS") for r in found.remarks)


@pytest.mark.parametrize(
    ("most", "unit", "scale"), [(0.3, "rad", 1.0), (5.0, "deg", 1.0), (95.0, "rad", "EDIT")]
)
def test_no_stick_tilts_a_blade_by_a_radian(most: float, unit: str, scale: float | str) -> None:
    series = Series(np.arange(50.0), np.linspace(-most, most, 50))
    found = scaled("aileron", series, "rad", is_input=True)
    assert (found.unit, found.scale) == (unit, scale)


def test_an_aeroplanes_commands_have_an_unknown_scale(tmp_path: Path) -> None:
    clock = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), ("float[3]", "xyz")]
    rows = [(5000 * i, 5000 * i, math.sin(i / 9), 0.2, math.cos(i / 7)) for i in range(1, 400)]
    topics = [(f"vehicle_{n}", 0, clock, rows) for n in ("angular_velocity", "torque_setpoint")]
    (tmp_path / "plane.ulg").write_bytes(ulog(topics, [("MAV_TYPE", 1)], [("sys_name", "PX4")]))
    write_config(tmp_path / "plane.ulg", tmp_path / "plane.yaml")
    content = yaml.safe_load((tmp_path / "plane.yaml").read_text())
    inputs = content["flights"][0]["signals"]["inputs"]
    assert {n: (i["unit"], i["scale"]) for n, i in inputs.items()} == {
        "ail": ("rad", "EDIT"),
        "rud": ("rad", "EDIT"),
    }
    assert inputs["rud"]["invert"]
    # The preset alone would take full travel for a radian.
    text = (tmp_path / "plane.yaml").read_text()
    begin, end = text.index("      inputs:"), text.index("fit:")
    (tmp_path / "plane.yaml").write_text(text[:begin] + text[end:])
    with pytest.raises(InputError, match="ail"):
        read_flights(load_config(tmp_path / "plane.yaml"))


@pytest.mark.parametrize(
    ("firmware", "parameters", "vehicle"),
    [
        ("ArduPlane V4.3", {}, "aeroplane"),
        ("ArduPlane V4.3", {"Q_ENABLE": 1.0}, "other vehicle"),
        ("ArduRover V4.3", {"FRAME_CLASS": 1.0}, "other vehicle"),
        ("ArduCopter V4.5.1", {"FRAME_CLASS": 1.0}, "multirotor"),
        ("ArduCopter V4.5.1", {"FRAME_CLASS": 0.0}, ""),
        ("ArduCopter V4.5.1", {"FRAME_CLASS": 6.0, "H_SW_TYPE": 3.0}, "helicopter"),
        ("ArduCopter V3.1 (heli)", {"FRAME": 0.0}, ""),
        ("", {}, ""),
        ("PX4 A", {"MAV_TYPE": 22}, "other vehicle"),
        ("PX4 A", {"MAV_TYPE": 1}, "aeroplane"),
        ("PX4 A", {"MAV_TYPE": 2, "CA_AIRFRAME": 10}, "helicopter"),
        ("PX4 A", {"MAV_TYPE": 4}, "helicopter"),
        ("PX4 A", {"CA_AIRFRAME": 0}, "multirotor"),
        ("Betaflight 4.4.0 S405", {}, "multirotor"),
        ("Rotorflight 4.3.0", {}, "helicopter"),
    ],
)
def test_what_vehicle_a_log_is_of(firmware: str, parameters, vehicle: str) -> None:
    topics = (Topic("main", np.arange(9.0), {"x": np.zeros(9)}, {}, "time"),)
    log = ChannelLog("a", "any", 1, "0", topics, firmware, parameters)
    assert vehicle_of(log)[0] == vehicle


def test_sticks_that_count_to_their_stops() -> None:
    values = np.round(np.linspace(-274, 270, 50))

    def stick(name: str) -> tuple[str, float | str]:
        found = scaled(name, Series(np.arange(50.0), values), "1")
        return found.unit, found.scale

    # Betaflight's commands are in steps of pulse widths.
    assert stick("rcCommand[0]") == ("1", 1 / 500)
    assert stick("Ail") == ("1", 0.001)
    # Whole numbers are not rad/s, however small.
    rate = Series(np.arange(50.0), np.round(np.linspace(-5, 6, 50)))
    assert scaled("gyroADC[0]", rate, "rad/s").unit == "deg/s"


@pytest.mark.parametrize("unit", ["us", "µs", "usec"])
def test_pulse_widths_by_the_unit_of_the_file_get_scale_and_offset(
    tmp_path: Path, unit: str
) -> None:
    """Test that a stick in microseconds is a receiver's, not a time."""
    columns = {"t": T, "aileron": 1500.0 + 400.0 * STICK, "p": RATE}
    lines = write(tmp_path / "run.csv", columns).read_text().splitlines()
    log, out = tmp_path / "run.csv", tmp_path / "run.yaml"
    log.write_text("\n".join((lines[0], f"s,{unit},rad/s", *lines[1:])) + "\n")
    assert cli.main(["new", str(log), "--out", str(out)]) == 0
    (flight,) = read_flights(load_config(out))
    np.testing.assert_allclose(flight.inputs["lat"], 0.8 * STICK, atol=1e-6)
    np.testing.assert_allclose(flight.outputs["p"], RATE, atol=1e-6)


def test_pulses_rest_where_the_record_begins_unless_a_manoeuvre_goes_on_there() -> None:
    moves = np.repeat([1300.0, 1650.0, 1420.0, 1580.0, 1500.0] * 4, 25)

    def offset(first: float, samples: int) -> float:
        values = np.concatenate([np.full(samples, first), moves])
        return scaled("rc_ch1", Series(0.01 * np.arange(values.size), values), "1").offset

    assert offset(1754.0, 30) == 1500.0
    assert offset(1532.0, 30) == 1532.0
    # A collective, for example.
    assert offset(1754.0, 300) == 1754.0


def test_of_a_stick_logged_twice_the_one_with_a_unit_is_taken(tmp_path: Path) -> None:
    columns = {"t": T, "rc_aileron": np.round(700 * STICK), "rc_aileron(percent)": 100 * STICK}
    log, out = write(tmp_path / "run.csv", columns | {"p": RATE}), tmp_path / "run.yaml"
    assert cli.main(["new", str(log), "--out", str(out)]) == 0
    lat = Config.model_validate(yaml_file.read_mapping(out)).flights[0].signals.inputs["lat"]
    assert (lat.signal, lat.scale) == ("rc_aileron(percent)", 1.0)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda rows: [*rows, "Mean,0.1,0.2", "Sum,1,2"],
        lambda rows: rows[:300] + [f"{float(r.split(',')[0]) - 2},0,0" for r in rows[300:]],
    ],
)
def test_a_clock_that_is_no_clock_throughout_is_refused(tmp_path: Path, spoil: Callable) -> None:
    log = write(tmp_path / "run.csv", {"t": T, "aileron": STICK, "p": RATE})
    head, *rows = log.read_text().splitlines()
    log.write_text("\n".join([head, *spoil(rows)]) + "\n")
    assert cli.main(["new", str(log), "--out", str(tmp_path / "x.yaml")]) == 2
    assert not (tmp_path / "x.yaml").exists()


def test_a_counter_of_rows_is_no_clock(tmp_path: Path) -> None:
    log = write(tmp_path / "run.csv", {"Frame": np.arange(T.size), "aileron": STICK, "p": RATE})
    out = tmp_path / "x.yaml"
    assert cli.main(["new", str(log), "--out", str(out)]) == 0
    assert "time: {rate: EDIT}" in out.read_text()
    assert cli.main(["check", str(out)]) == 2
    out.unlink()
    assert cli.main(["new", str(log), "--time-rate", "50", "--out", str(out)]) == 0
    assert "time: {rate: 50}" in out.read_text()


@pytest.mark.parametrize(
    ("name", "si", "called", "may"),
    [
        ("Batt_V", "m/s", ["v", "right speed"], False),
        ("Batt_v", "m/s", ["v"], False),
        ("body.v", "m/s", ["v"], True),
        ("Vlat_kt", "m/s", ["v", "vlat"], True),
        ("GyroRoll_dps", "rad", ["phi", "roll"], False),
        ("GyroRoll", "rad", ["phi", "roll"], False),
        ("GyroRoll", "rad/s", ["p", "gyro roll"], True),
        ("IMU.GyrX", "rad/s", ["p", "gyr x"], True),
        ("IMU.AccX", "rad/s", ["p", "gyr x"], False),
        ("Roll_rpm", "rad", ["phi", "roll"], False),
    ],
)
def test_a_name_or_a_unit_of_another_quantity_is_no_match(
    name: str, si: str, called: list[str], may: bool
) -> None:
    series = Series(T, RATE)
    assert (may_be(name, series, called, si) and by_name(called, [name]) == [name]) == may


def test_a_logged_sweep_is_offered_as_an_instrument_and_dead_channels_are_no_signals(
    tmp_path: Path,
) -> None:
    columns = {"SweepAil": 0.5 * STICK} | table("GyroRoll_dps")
    columns |= {"Bank": np.full(T.size, np.nan), "Batt_V": columns.pop("battery")}
    log, out = write(tmp_path / "run.csv", columns), tmp_path / "run.yaml"
    assert cli.main(["new", str(log), "--out", str(out)]) == 0
    text = out.read_text()
    assert "#   lat: {signal: SweepAil}" in text
    made = Config.model_validate(
        yaml_file.parse_mapping(
            text.replace("      # ins", "      ins").replace("      #   lat", "        lat"), "x"
        )
    )
    signals = made.flights[0].signals
    assert signals.inputs["lat"].signal == "aileron_pwm"
    assert {n: o.signal for n, o in signals.outputs.items()} == {"p": "GyroRoll_dps"}
    assert signals.instruments["lat"].signal == "SweepAil"


@pytest.mark.parametrize(
    "rate", ["rate_deg_s", "rate_deg_per_s", "rate_degrees_per_second", "rate [deg s-1]", "rate"]
)
def test_a_rate_is_never_taken_for_the_stick(tmp_path: Path, rate: str) -> None:
    columns = table(f"roll_{rate}", "output 1")
    columns["roll_deg"] = np.degrees(np.cumsum(RATE) * 0.02)
    log, out = write(tmp_path / "run.csv", columns), tmp_path / "run.yaml"
    assert cli.main(["new", str(log), "--model", "roll-flybarless", "--out", str(out)]) == 0
    signals = yaml_file.read_mapping(out)["flights"][0]["signals"]
    assert signals["outputs"]["p"]["signal"] == f"roll_{rate}"
    # No name is that of a stick, so the user must name it.
    assert signals["inputs"] == {"lat": {"signal": "EDIT"}}
    assert cli.main(["fit", str(out), "--out", str(tmp_path / "fit")]) == 2


def test_numbered_channels_are_guesses(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).standard_normal((2, T.size))
    columns = {"t": T, "chan1_raw": 1500 + 400 * STICK, "chan2_raw": 1500 + 30 * noise[0]}
    columns |= {"rollspeed": RATE, "pitchspeed": 0.1 * noise[1]}
    out = tmp_path / "two.yaml"
    log = write(tmp_path / "two.csv", columns)
    assert (
        cli.main(["new", str(log), "--out", str(out), "--model", "linear:attitude-flybarless"]) == 0
    )
    lines = [line for line in out.read_text().splitlines() if "_raw" in line]
    assert len(lines) == 2
    assert all("GUESS: by its number" in line for line in lines)


def test_of_letters_that_differ_in_case_the_model_s_own_is_taken(tmp_path: Path) -> None:
    columns = {"time": T, "aileron": STICK, "p": RATE, "P": 7.0 * RATE}
    log, out = write(tmp_path / "log.csv", columns), tmp_path / "c.yaml"
    write_config(log, out, model="linear:roll-flybarless")
    text = out.read_text()
    assert "p: {signal: p, unit: rad/s}" in text
    # Fixed parameters have another vehicle's values.
    assert "    # tau_f: {start: 0.04631}" in text


def test_a_latitude_is_no_lateral_stick() -> None:
    t = 0.1 * np.arange(100)

    def log(**values: np.ndarray) -> dict[str, Series]:
        return {name.replace("__", "."): Series(t, x) for name, x in values.items()}

    stick = 0.3 * np.sin(t)
    places = log(AHR2__Lat=stick, AHR2__Lng=stick, gps_lat=51.4 + 1e-3 * stick, lat=stick)
    assert [name for name in places if is_place(name, places)] == [
        "AHR2.Lat",
        "AHR2.Lng",
        "gps_lat",
    ]
    sticks = log(lat=stick, lon=0.2 + stick, rc__lat=1500 + 5 * stick, rc__lon=1500 + 0 * stick)
    assert not [name for name in sticks if is_place(name, sticks)]
    assert is_place("lat", log(lat=514234567 + 900 * stick))
