"""Blackbox logs: values of an independent writer; damage loses as little as possible."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heli_jax.errors import InputError
from heli_jax.flights import Signal, read_flight
from heli_jax.flights.formats.blackbox_frames import decode
from heli_jax.flights.open_log import open_flights, open_log

from . import log_writers as writers

REAL = Path(__file__).parents[2] / ".." / "shared" / "data" / "rotorflight" / "LOG246.TXT"
BITS = {0: 32, 1: 32, 3: 14, 6: 32, 7: 32, 8: 16, 9: 1, 10: 32}
NAMES = ["gyroADC[0]", "gyroADC[1]", "gyroADC[2]", "setpoint[0]", "motor"]
PREDICTORS, ENCODINGS = [1, 3, 2, 1, 0], [10, 10, 10, 6, 0]


def some_values(n=200, seed=0, step=1):
    rng = np.random.default_rng(seed)
    rows = np.arange(n)
    gyros = np.cumsum(rng.integers(-30, 31, (n, 3)), axis=0)
    steps = 100 * (rows[:, None] // 40 % 3) - 70
    time = 5_000_000 + 2000 * rows + rng.integers(-3, 4, n)
    return np.column_stack([step * rows, time, gyros, steps, rng.integers(-500, 500, n)])


def some_flight(**changes):
    return writers.blackbox(NAMES, some_values(), PREDICTORS, ENCODINGS, **changes)


def first_frame(data):
    """Return the position of the first frame, after the last line of the header."""
    return data.index(b"\n", data.index(b"H Field P encoding")) + 1


def opened(tmp_path, data, name="flight.bbl"):
    path = tmp_path / name
    path.write_bytes(data)
    return open_flights(path)


@st.composite
def frames(draw):
    encodings = draw(st.lists(st.sampled_from(sorted(BITS)), min_size=1, max_size=9))
    rows = draw(st.integers(1, 3))
    values = []
    for encoding in encodings:
        half = 1 << BITS[encoding] - 1
        low, high = (0, 2 * half - 1) if encoding == 1 else (-half, half - 1)
        if encoding == 9:
            low = high = 0
        small = st.integers(max(low, -40), min(high, 40))
        values.append(draw(st.lists(small | st.integers(low, high), min_size=rows, max_size=rows)))
    return encodings, np.array(values, np.int64).T


@given(frames())
def test_each_encoding_gives_back_what_was_written(frame):
    encodings, values = frame
    parts = [writers.encode(row, encodings) for row in values.tolist()]
    data = np.frombuffer(b"".join(parts) + b"P", np.uint8)
    starts = np.cumsum([0, *(len(p) for p in parts)])
    decoded, ends = decode(data, starts[:-1].astype(np.int64), tuple(encodings))
    assert ends.tolist() == starts[1:].tolist()
    np.testing.assert_array_equal(decoded, values)


@pytest.mark.parametrize("step", [1, 4])
def test_values_come_back(tmp_path, step):
    values = some_values(step=step)
    data = writers.blackbox(NAMES, values, PREDICTORS, ENCODINGS, step=step, slow=[(0, 3), (50, 7)])
    (log,) = opened(tmp_path, data)
    assert log.notes == ()
    for i, name in enumerate(["loopIteration", "time", *NAMES]):
        times, column = log.channel(name)
        np.testing.assert_array_equal(column, values[:, i])
        np.testing.assert_array_equal(times, values[:, 1] * 1e-6)
    times, mode = log.channel("mode")
    assert mode.tolist() == [3.0, 7.0]
    assert times[1] == values[49, 1] * 1e-6


def test_a_damaged_frame_costs_what_depends_on_it(tmp_path):
    data = bytearray(some_flight())
    values = some_values()
    at = data.index(b"P", first_frame(data) + 100)
    del data[at : at + 3]
    (log,) = opened(tmp_path, bytes(data))
    _, iterations = log.channel("loopIteration")
    # Some of the first 32 are lost; from the next I frame all are read with their values.
    assert np.all(iterations[iterations >= 32] == np.arange(32, 200))
    assert iterations.size < 200
    for i, name in enumerate(NAMES):
        np.testing.assert_array_equal(log.channel(name)[1], values[iterations.astype(int), 2 + i])
    assert log.notes[0].code == "damage.skipped"


def test_a_counter_that_begins_anew_goes_on_and_positions_are_left_out(tmp_path):
    values = some_values()
    values[:, 1] += 2**32 - 100_000 - values[0, 1]
    gps = [(20, 700, 9), (40, 900, 10), (120, 300, 11)]
    data = writers.blackbox(NAMES, values, PREDICTORS, ENCODINGS, gps=gps)
    (log,) = opened(tmp_path, data)
    np.testing.assert_allclose(log.channel("gyroADC[0]")[0], values[:, 1] * 1e-6, rtol=1e-12)
    assert [(n.code, n.value) for n in log.notes] == [("channels.left-out", 3)]


def test_several_flights_in_one_file(tmp_path):
    second = writers.blackbox(NAMES, some_values(80, 1), PREDICTORS, ENCODINGS)
    path = tmp_path / "LOG.TXT"
    path.write_bytes(some_flight() + second)
    first, other = open_flights(path)
    assert (first.flight, other.flight) == ((1, 2), (2, 2))
    with pytest.raises(InputError):
        open_log(path)
    with pytest.raises(InputError):
        open_log(path, 3)
    signals = {
        "inputs": {"u": Signal("motor", "1", "1")},
        "outputs": {"p": Signal("gyroADC[0]", "deg/s", "rad/s")},
    }
    flight = read_flight(path, **signals, rate=500.0, number=2)
    # Stamps jitter by 3 us, so samples move by 3/2000 of their neighbours' difference.
    wanted = some_values(80, 1)[:, 2] * np.pi / 180
    np.testing.assert_allclose(flight.outputs["p"][:78], wanted[:78], atol=0.1 * np.pi / 180)
    assert (flight.n_samples, flight.dt) == (pytest.approx(80, abs=1), 1 / 500)


def test_units_that_the_header_makes_sure(tmp_path):
    (log,) = opened(tmp_path, some_flight(settings=[("gyro_scale", "0x3f800000")]))
    assert log.topics[0].units["gyroADC[0]"] == "deg/s"
    (log,) = opened(tmp_path, some_flight())
    assert "gyroADC[0]" not in log.topics[0].units


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"Data version:2", b"Data version:1"),
        (b"H Field P encoding:9,0", b"H Field P encoding:9,5"),
        (b"H Field P predictor:6", b"H Field P predictor:99"),
        (b"H Field P predictor:6,", b"H Field P predictor:"),
        (b",time,", b",tide,"),
        (b"gyroADC[1]", b"gyroADC[0]"),
    ],
)
def test_headers_that_cannot_be_read(tmp_path, old, new):
    with pytest.raises(InputError):
        opened(tmp_path, some_flight().replace(old, new, 1))


def test_a_header_alone_is_no_flight(tmp_path):
    data = some_flight()
    with pytest.raises(InputError):
        opened(tmp_path, data[: first_frame(data)])


@pytest.mark.skipif(not REAL.exists(), reason="the real logs are not at ../shared/data")
def test_the_rotorflight_log():
    (log,) = open_flights(REAL)
    times, headspeed = log.channel("headspeed")
    # Two other decoders give 9389 and 9390 frames, and 3566 rpm.
    assert times.size in (9389, 9390)
    assert (headspeed.min(), headspeed.max()) == (0.0, 3566.0)
    assert np.median(np.diff(times)) == pytest.approx(1 / 500, rel=1e-3)
    assert times[-1] - times[0] == pytest.approx(18.8, abs=0.05)
    assert "Rotorflight 4.3.0" in log.firmware
    assert log.topics[0].units["gyroADC[0]"] == "deg/s"
    # The loop count increases by four throughout: no frame is missing.
    assert set(np.diff(log.channel("loopIteration")[1])) == {4.0}
