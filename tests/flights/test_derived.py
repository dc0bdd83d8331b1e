"""Quaternions, wrapped angles and swashplates, against SciPy and by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from heli_jax.errors import InputError
from heli_jax.flights import Signal, describe_log, read_flight
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.derived import Swashplate, body_velocity, euler_angles, unmix, with_derived
from heli_jax.flights.open_log import open_log

from . import log_writers as writers

# Two turns in yaw, over the vertical in roll.
ANGLES = np.stack(
    [np.linspace(-3, 5, 200), 0.9 * np.sin(np.arange(200) / 9), np.linspace(0, 13, 200)]
)


def quaternions(angles):
    x, y, z, w = Rotation.from_euler("ZYX", angles[::-1].T).as_quat().T
    return np.stack([w, x, y, z])


def test_euler_angles_are_scipys_and_do_not_jump():
    q = quaternions(ANGLES) * 1.7  # of any length
    q[:, 50] *= -1.0  # the same attitude
    q[:, 80] = np.nan
    got = euler_angles(q)
    assert np.isnan(got[:, 80]).all()
    rest = np.arange(200) != 80
    np.testing.assert_allclose(got[:, rest], ANGLES[:, rest], atol=1e-12)


def test_body_velocity_is_scipys():
    velocity = np.stack([np.cos(np.arange(200) / 7), np.arange(200) / 50, -np.ones(200)])
    want = Rotation.from_euler("ZYX", ANGLES[::-1].T).inv().apply(velocity.T).T
    np.testing.assert_allclose(body_velocity(2 * quaternions(ANGLES), velocity), want, atol=1e-12)


def test_marks_in_the_sources_are_missing_in_what_is_derived(tmp_path):
    t = 0.01 * np.arange(200)
    q, h, north = quaternions(ANGLES), 100 * t % 360, np.cos(t)
    q[0, 50:60], q[1:, 50:60], h[80:83], north[20] = -9999, 0.5, -9999, -9999
    columns = {"t": t, "u": np.sin(9 * t), "n": north, "e": t, "d": -t, "h": h}
    columns |= dict(zip(("q0", "q1", "q2", "q3"), q, strict=True))
    path = tmp_path / "log.csv"
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")
    roll, speed = "euler(q0, q1, q2, q3).roll", "body_velocity(q0, q1, q2, q3, n, e, d).v"
    outputs = {
        "phi": Signal(roll, "rad", "rad"),
        "v": Signal(speed, "m/s", "m/s"),
        "psi": Signal("unwrap(h, 360)", "deg", "rad"),
    }
    inputs = {"u": Signal("u", "1", "1")}
    f = read_flight(path, time="t", inputs=inputs, outputs=outputs)
    for name, rows in (
        ("phi", {*range(50, 60)}),
        ("v", {20, *range(50, 60)}),
        ("psi", {80, 81, 82}),
    ):
        assert set(np.flatnonzero(np.isnan(f.outputs[name]))) == rows, name
    rest = np.isfinite(f.outputs["phi"])
    np.testing.assert_allclose(f.outputs["phi"][rest], ANGLES[0, rest], atol=1e-12)
    assert f.source is not None
    assert 10 in [n.value for n in f.source.notes if n.code == "samples.missing"]
    got = convert_log(path, Selection(signals=(roll,)))
    assert np.isnan(got.columns[roll][50:60]).all()
    assert 10 in [n.value for n in got.notes if n.code == "samples.missing"]
    # Other parts of the log are not mentioned.
    f = read_flight(path, time="t", inputs=inputs, outputs=outputs, window=(1.0, 1.9))
    assert f.source is not None
    assert "samples.marks" not in {n.code for n in f.source.notes}
    said = {n.subjects: n.value for n in describe_log(path).notes if n.code == "samples.marks"}
    assert said["h",] == 3
    inputs = {"u": Signal("unwrap(h, 360)", "deg", "deg")}
    with pytest.raises(InputError, match="line 82"):
        read_flight(path, time="t", inputs=inputs, outputs={"p": Signal("u", "1", "1")})
    plate = Swashplate(
        ("n", "e", "d"), (-60, 60, 180), *((1.0,) * 3, (0.0,) * 3, (1.0,) * 3), (False,) * 3
    )
    lift = {"lift": Signal("ccpm.collective", "1", "1")}
    inputs = {"u": Signal("u", "1", "1")}
    f = read_flight(path, time="t", inputs=inputs, outputs=lift, swashplate=plate)
    assert np.flatnonzero(np.isnan(f.outputs["lift"])).tolist() == [20]


ATTITUDE = [("uint64_t", "timestamp"), ("float[4]", "q")]
SPEED = [("uint64_t", "timestamp"), ("float", "vx"), ("float", "vy"), ("float", "vz")]


@pytest.fixture
def flown(tmp_path):
    """Write attitude at 100 Hz in a yaw turn with a gap; 3 m/s to the north at 20 Hz."""
    yaw = np.linspace(0, 2 * np.pi, 200)
    q = quaternions(np.stack([0 * yaw, 0 * yaw, yaw]))
    q[:, 20::2] *= -1.0
    rows = [(10_000 * i, *q[:, i]) for i in range(200) if not 100 < i < 150]
    speeds = [(50_000 * i, 3.0, 0.0, -1.0) for i in range(40)]
    path = tmp_path / "flight.ulg"
    topics = [("att", 0, ATTITUDE, rows), ("pos", 0, SPEED, speeds)]
    path.write_bytes(writers.ulog(topics, start=0))
    return path


def test_derived_channels_of_a_log(flown):
    log = with_derived(open_log(flown))
    times, yaw = log.channel("euler(att.q).yaw")
    np.testing.assert_allclose(yaw, times / 1.99 * 2 * np.pi, atol=1e-6)
    assert log.topic_of("euler(att.q).yaw").name == "att"
    # Attitude is interpolated to the speed's clock; within the gap it is unknown.
    times, u = log.channel("body_velocity(att.q, pos.vx, pos.vy, pos.vz).u")
    lost = (times > 1.0) & (times < 1.5)
    assert (np.isnan(u) == lost).all()
    np.testing.assert_allclose(u[~lost], 3 * np.cos(2 * np.pi * times[~lost] / 1.99), atol=2e-3)
    flight = read_flight(
        flown,
        inputs={"w": Signal("pos.vx", "m/s", "m/s")},
        outputs={"yaw": Signal("euler(att.q[0], att.q[1], att.q[2], att.q[3]).yaw", "rad", "rad")},
        rate=50.0,
        window=(0.0, 0.9),
    )
    np.testing.assert_allclose(flight.outputs["yaw"], 2 * np.pi * flight.times / 1.99, atol=1e-4)


@pytest.mark.parametrize(
    "name",
    [
        "eulr(att.q).yaw",
        "euler(att.q).jaw",
        "unwrap(att.q[0], no)",
        "unwrap(att.q[0], -1)",
        "euler(at.q).yaw",
        "euler(att.q[0], att.q[1], att.q[2], pos.vx).yaw",
        "ccpm.roll",
    ],
)
def test_wrong_derivations(flown, name):
    with pytest.raises(InputError):
        with_derived(open_log(flown)).channel(name)


def test_derived_columns_of_a_table(tmp_path):
    t = np.arange(40) / 20
    heading = np.degrees(3 * t) % 360
    path = tmp_path / "flight.csv"
    lines = [f"{a},{b},{c}" for a, b, c in zip(t, heading, np.sin(t), strict=True)]
    path.write_text("\n".join(["t,yaw,stick", *lines]))
    flight = read_flight(
        path,
        time="t",
        inputs={"stick": Signal("stick", "1", "1")},
        outputs={"psi": Signal("unwrap(yaw, 360)", "deg", "rad")},
    )
    np.testing.assert_allclose(flight.outputs["psi"], 3 * t, atol=1e-9)


def plate(angles, **changes):
    n = len(angles)
    servos = tuple(f"RCOU.C{i}" for i in range(n))
    parts = {"radius": (1.0,) * n, "offset": (0.0,) * n, "scale": (1.0,) * n}
    parts |= {"invert": (False,) * n} | changes
    return Swashplate(servos, tuple(map(float, angles)), **parts)


HALF, SIN60 = 0.5, np.sqrt(0.75)
SIN40, COS40 = np.sin(np.radians(40)), np.cos(np.radians(40))


@pytest.mark.parametrize(
    ("angles", "collective", "roll", "pitch"),
    [
        # Front left, front right, rear: 120 degrees apart. In a roll to the right the right servo
        # lowers.
        ((-60, 60, 180), (1, 1, 1), (SIN60, -SIN60, 0), (HALF, HALF, -1)),
        # 140 degrees from the rear servo.
        ((-40, 40, 180), (1, 1, 1), (SIN40, -SIN40, 0), (COS40, COS40, -1)),
        # Four at the corners, and four on the axes.
        ((-45, 45, 135, -135), (1,) * 4, np.sqrt(HALF) * np.array([1, -1, -1, 1]),
         np.sqrt(HALF) * np.array([1, 1, -1, -1])),
        ((0, 90, 180, 270), (1,) * 4, (0, -1, 0, 1), (1, 0, -1, 0)),
    ],
)  # fmt: skip
def test_a_swashplate_by_hand(angles, collective, roll, pitch):
    wanted = np.array([[0.3, 0.0], [-0.2, 0.5], [0.1, -0.4]])
    lifts = np.stack([collective, roll, pitch], axis=1) @ wanted
    np.testing.assert_allclose(unmix(plate(angles), lifts), wanted, atol=1e-12)
    # The same as PWM around 1500, with the second servo inverted, at half the radius.
    n = len(angles)
    invert = tuple(i == 1 for i in range(n))
    pwm = 1500 + lifts / 0.002 * np.where(invert, -1, 1)[:, None]
    scales = {"offset": (1500.0,) * n, "scale": (0.002,) * n, "invert": invert}
    got = unmix(plate(angles, radius=(0.5,) * n, **scales), pwm)
    np.testing.assert_allclose(got, wanted * [[1], [2], [2]], atol=1e-12)


def test_more_servos_than_three_are_a_least_squares_problem():
    # A fourth servo that sticks, by hand: (1, 1, -1, -1)/4 of its error is not a motion of a plane.
    lifts = np.array([[1.0], [0.0], [0.0], [0.0]])
    got = unmix(plate((0, 90, 180, 270)), lifts)
    np.testing.assert_allclose(got, [[0.25], [0.0], [0.5]], atol=1e-12)


def test_the_phase_turns_the_axes():
    swashplate = plate((-60, 60, 180), phase=90.0)
    got = unmix(swashplate, np.array([[SIN60], [-SIN60], [0.0]]))
    # A tilt to the right of a plate without phase is one about the other axis here.
    np.testing.assert_allclose(got, [[0.0], [0.0], [-1.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("angles", "changes"),
    [
        ((0, 180, 180.5), {}),
        ((0, 90), {}),
        ((0, 120, 240), {"radius": (1.0, 0.0, 1.0)}),
        ((0, 120, 240), {"scale": (1.0, 0.0, 1.0)}),
        ((0, 120, 240), {"offset": (1.0, 0.0)}),
    ],
)
def test_no_swashplate(angles, changes):
    with pytest.raises(ValueError, match="expected"):
        plate(angles, **changes)
