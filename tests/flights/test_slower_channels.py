"""Outputs slower than the grid: missing between their samples."""

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import Signal, read_flight
from heli_jax.flights.marks import written_again
from heli_jax.flights.resample import Timed, at_nearest
from heli_jax.numerics.white_noise import noise_guess

from . import log_writers as writers

N = 400
"""Samples at 100 Hz."""


def motion(t):
    return 0.4 * np.sin(2.0 * t) + 0.1 * np.cos(5.0 * t)


def ulog_of_a_slow_sensor(tmp_path, stamps):
    """Write sticks and a gyro at 100 Hz from 0 s, and positions at the `stamps` [s]."""
    fast = np.arange(N) / 100
    start = 10_000_000
    rows = [(start + round(1e6 * t), np.sin(t), np.cos(t)) for t in fast]
    slow = [(start + round(1e6 * t), float(motion(t))) for t in stamps]
    topics = [
        ("gyro", 0, [("float", "u"), ("float", "p")], rows),
        ("gps", 0, [("float", "x")], slow),
    ]
    topics = [(n, i, [("uint64_t", "timestamp"), *fields], r) for n, i, fields, r in topics]
    path = tmp_path / "flight.ulg"
    path.write_bytes(writers.ulog(topics, start=start))
    return path


SIGNALS = {
    "inputs": {"u": Signal("gyro.u", "1", "1")},
    "outputs": {"p": Signal("gyro.p", "1", "1"), "x": Signal("gps.x", "1", "1")},
}


def test_a_slow_sensor_is_missing_between_its_samples(tmp_path):
    rng = np.random.default_rng(0)
    stamps = 0.15 + 0.2 * np.arange(19) + rng.uniform(-0.004, 0.004, 19)
    flight = read_flight(ulog_of_a_slow_sensor(tmp_path, stamps), **SIGNALS, rate=100.0)
    # Its late first sample does not shorten the others.
    assert flight.n_samples == N
    at = np.rint(100 * stamps).astype(int)
    assert np.array_equal(np.flatnonzero(np.isfinite(flight.outputs["x"])), at)
    assert np.isfinite(flight.outputs["p"]).all()
    # At most half of the error without moving it remains.
    error = np.abs(flight.outputs["x"][at] - motion(at / 100))
    still = np.abs(motion(stamps) - motion(at / 100))
    assert error.max() < 0.25 * still.max()
    slower = [(n.subjects, n.value) for n in flight.source.notes if n.code == "resampling.slower"]
    assert slower == [(("x",), 19)]


def test_an_output_near_the_rate_is_resampled_as_before(tmp_path):
    stamps = np.arange(280) / 70  # 1.43 steps of 100 Hz
    flight = read_flight(ulog_of_a_slow_sensor(tmp_path, stamps), **SIGNALS, rate=100.0)
    wanted = np.interp(flight.times, stamps, motion(stamps))
    np.testing.assert_allclose(flight.outputs["x"], wanted, atol=1e-6)


def test_two_samples_never_share_an_instant():
    seconds = np.array([0.0, 0.041, 0.043, 0.08, 0.12, 0.161])
    placed = at_nearest(Timed(seconds, 3.0 * seconds), np.arange(9) * 0.02)
    # A straight line stays on itself.
    np.testing.assert_allclose(placed[[0, 2, 4, 6, 8]], [0, 0.12, 0.24, 0.36, 0.48])
    assert np.isnan(placed[[1, 3, 5, 7]]).all()


def test_the_noise_of_a_moved_sample_stays_its_own():
    rng = np.random.default_rng(1)
    seconds = 0.0055 + 0.017 * np.arange(20_000)
    placed = at_nearest(Timed(seconds, rng.standard_normal(20_000)), 0.01 * np.arange(34_000))
    noise = placed[~np.isnan(placed)]
    assert np.var(noise) == pytest.approx(1.0, abs=0.06)
    assert abs(np.corrcoef(noise[:-1], noise[1:])[0, 1]) < 0.03


def table(tmp_path, x, **options):
    """Return a flight of a 100 Hz table with a stick, a fast output and `x`."""
    t = np.arange(len(x)) / 100
    cells = ["" if np.isnan(v) else repr(float(v)) for v in x]
    rows = [
        f"{a:.2f},{float(np.sin(a))!r},{float(np.cos(a))!r},{c}"
        for a, c in zip(t, cells, strict=True)
    ]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["t,u,p,x", *rows]))
    repeats = options.pop("repeats", "auto")
    outputs = {"p": Signal("p", "1", "1"), "x": Signal("x", "1", "1", repeats=repeats)}
    inputs = {"u": Signal("u", "1", "1")}
    return read_flight(path, time="t", inputs=inputs, outputs=outputs, **options)


def test_a_column_filled_in_every_twentieth_row(tmp_path):
    t = np.arange(N) / 100
    x = np.where(np.arange(N) % 20 == 3, motion(t), np.nan)
    np.testing.assert_array_equal(table(tmp_path, x).outputs["x"], x)
    # At half the rate its samples are at other instants; their number is the same.
    half = table(tmp_path, x, rate=50.0)
    assert np.isfinite(half.outputs["x"]).sum() == 20
    seen = np.isfinite(half.outputs["x"])
    np.testing.assert_allclose(half.outputs["x"][seen], motion(half.times[seen]), atol=2e-3)
    # At its own rate no sample is missing.
    own = table(tmp_path, x, rate=5.0).outputs["x"]
    assert np.isfinite(own[1:-1]).all()


def test_repeated_values_are_one_measurement(tmp_path):
    t = np.arange(600) / 100
    x = motion(t)[np.arange(600) // 20 * 20]
    flight = table(tmp_path, x)
    at = np.arange(0, 600, 20)
    assert np.array_equal(np.flatnonzero(np.isfinite(flight.outputs["x"])), at)
    np.testing.assert_array_equal(flight.outputs["x"][at], x[at])
    assert [n.value for n in flight.source.notes if n.code == "repeats.missing"] == [570]
    np.testing.assert_array_equal(table(tmp_path, x, repeats="keep").outputs["x"], x)


def test_what_is_not_unmistakable_is_kept(tmp_path):
    t = np.arange(2000) / 100
    # A slow ramp in whole counts repeats values regularly, and one in whole degrees irregularly.
    for y in (np.floor(5.0 * t), np.round(20.0 * motion(t)), motion(t), np.zeros(2000)):
        assert not written_again(y).any()
    # The runs are few, but a user's statement is accepted.
    x = motion(t[:200])[np.arange(200) // 20 * 20]
    assert np.isfinite(table(tmp_path, x).outputs["x"]).all()
    assert np.isfinite(table(tmp_path, x, repeats="missing").outputs["x"]).sum() == 10
    with pytest.raises(InputError):
        read_flight(
            tmp_path / "log.csv", time="t", inputs={"u": Signal("u", "1", "1", repeats="keep")},
            outputs={},
        )  # fmt: skip


def test_noise_is_guessed_across_missing_samples():
    rng = np.random.default_rng(2)
    t = np.arange(20_000) / 100
    x = np.sin(0.5 * t) + 0.01 * rng.standard_normal(t.size)
    at = np.cumsum(rng.integers(12, 28, 900))
    sparse = np.full(t.size, np.nan)
    sparse[at] = x[at]
    assert noise_guess(sparse) == pytest.approx(0.01, rel=0.1)
    assert noise_guess(x) == pytest.approx(0.01, rel=0.05)


def test_stale_rows_of_a_noisy_output_are_missing():
    rng, t = np.random.default_rng(0), np.arange(1500) / 50.0
    fresh = np.round(np.sin(2.0 * t) + 0.02 * rng.standard_normal(t.size), 5)
    assert not written_again(fresh).any()
    written, again = fresh.copy(), np.zeros(t.size, bool)
    for first in np.sort(rng.choice(np.arange(10, 1490), 60, replace=False)):
        for k in range(first, first + int(rng.integers(1, 4))):
            written[k], again[k] = written[k - 1], True
    np.testing.assert_array_equal(written_again(written), again)
    # Coarse steps, a smooth signal and a clipped one also repeat values.
    assert not written_again(np.round(fresh, 1)).any()
    assert not written_again(np.sin(2.0 * t)).any()
    assert not written_again(np.clip(fresh, -0.8, 0.8)).any()
