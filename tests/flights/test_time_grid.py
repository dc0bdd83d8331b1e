"""Stamps that count as a uniform grid, and resampling of the others."""

from bisect import bisect_right

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heli_jax.errors import InputError
from heli_jax.flights import Flight, Signal, read_flight
from heli_jax.flights.resample import held_mean, hold, interpolate


def read(path, stamps: list[str], x: np.ndarray | None = None, **request) -> Flight:
    x = np.arange(len(stamps)) ** 1.5 if x is None else x
    rows = (f"{t},{float(v)!r},{float(v)!r}" for t, v in zip(stamps, x, strict=True))
    path.write_text("\n".join(["t,u,y", *rows]))
    stick = Signal("u", "1", "1", hold="zero-order")
    asked = {"inputs": {"u": stick}, "outputs": {"y": Signal("y", "1", "1")}}
    return read_flight(path, time=request.pop("time", "t"), **asked, **request)


def notes(flight: Flight) -> set[str]:
    assert flight.source is not None
    return {n.code for n in flight.source.notes}


ROUNDED = {
    "100 Hz, two decimals": (100, "{:.2f}", 0.0),
    "30 Hz, milliseconds": (30, "{:.3f}", 0.0),
    "60 Hz, hundredths": (60, "{:.2f}", 0.0),
    "400 Hz, milliseconds": (400, "{:.3f}", 0.0),
    "800 Hz, milliseconds": (800, "{:.3f}", 0.0),
    "300 Hz, seven digits": (300, "{:.7g}", 999.0),
    "30 Hz, seven digits": (30, "{:.7g}", 9990.0),
}


@pytest.mark.parametrize("case", ROUNDED)
def test_rounded_stamps_pass(tmp_path, case):
    rate, form, start = ROUNDED[case]
    stamps = [form.format(start + i / rate) for i in range(600)]
    flight = read(tmp_path / "log.csv", stamps)
    assert flight.dt == pytest.approx(1 / rate, rel=1e-9)
    assert ("clock.jitter" in notes(flight)) == (case != "100 Hz, two decimals")


@pytest.mark.parametrize(("size", "noted"), [(0.003, False), (0.07, True)])
def test_jitter_is_noted(tmp_path, size, noted):
    t = np.arange(100) + size / 2 * np.random.default_rng(0).uniform(-1, 1, 100)
    flight = read(tmp_path / "log.csv", [repr(float(x)) for x in t])
    assert flight.dt == pytest.approx(1.0, rel=1e-3)
    assert ("clock.jitter" in notes(flight)) == noted


@pytest.mark.parametrize(
    ("line", "stamps"),
    [
        *((at + 2, [f"{0.01 * i:.2f}" for i in range(200) if i != at]) for at in (1, 50, 198)),
        (27, [f"{0.01 * i:.2f}" for i in range(2000) if i % 50 != 25]),
        (27, [f"{0.01 * i:.3f}" for i in range(2000) if i % 50 != 25]),
        (6, [f"{0.02 * i + 0.006 * (i == 4):.3f}" for i in range(60)]),
    ],
)
def test_lost_samples_and_a_late_stamp_are_no_rounding(tmp_path, line, stamps):
    with pytest.raises(InputError, match=f"line {line},"):
        read(tmp_path / "log.csv", stamps)


@pytest.mark.parametrize(
    "stamps",
    [
        [repr(i * 1e-320) for i in range(20)],
        [repr(i * 1e307) for i in range(15)],
        [repr(-1.7e308 + i * 2e307) for i in range(15)],
    ],
)
def test_stamps_of_no_clock(tmp_path, stamps):
    with pytest.raises(InputError):
        read(tmp_path / "log.csv", stamps)


def test_huge_values_survive_interpolation(tmp_path):
    x = 1.7e308 * (-1.0) ** np.arange(40)
    flight = read(tmp_path / "log.csv", [f"{0.01 * i:.2f}" for i in range(40)], x, rate=130.0)
    assert np.abs(flight.outputs["y"]).max() <= 1.7e308


def test_resampling_bridges_a_lost_sample(tmp_path):
    keep = np.delete(np.arange(100), 40)
    flight = read(tmp_path / "log.csv", [f"{0.01 * i:.2f}" for i in keep], keep, rate=100.0)
    want = np.arange(100.0)
    assert np.allclose(flight.outputs["y"], want, atol=1e-9)
    want[40] = 39.0
    assert np.array_equal(flight.inputs["u"], want)


@pytest.mark.parametrize("rate", [30.0, 49.0])
def test_rate_of_a_rounded_log_keeps_its_samples(tmp_path, rate):
    x = np.random.default_rng(1).normal(size=300)
    stamps = [f"{i / rate:.3f}" for i in range(300)]
    flight = read(tmp_path / "log.csv", stamps, x, rate=rate)
    assert flight.dt == 1 / rate
    assert "resampling.rate" not in notes(flight)
    assert np.array_equal(flight.inputs["u"], x)


@pytest.mark.parametrize("part", [2, 3, 5])
def test_a_slower_clock_takes_whole_samples(tmp_path, part):
    # Slow enough to pass the low-pass filter of outputs unchanged.
    x = np.sin(2 * np.pi * 0.3 * np.arange(300) / 30)
    stamps = [f"{i / 30:.3f}" for i in range(300)]
    flight = read(tmp_path / "log.csv", stamps, x, rate=30.0 / part)
    # A held input has the mean over each step; after its last sample it is constant.
    means = np.r_[x, np.repeat(x[-1], part)][: part * flight.n_samples].reshape(-1, part).mean(1)
    np.testing.assert_allclose(flight.inputs["u"], means, rtol=0, atol=1e-9)
    assert np.allclose(flight.outputs["y"][3:-3], x[::part][3:-3], atol=2e-3)


def test_held_inputs_do_not_slip_on_rounded_stamps(tmp_path):
    x = np.random.default_rng(1).normal(size=300)
    flight = read(tmp_path / "log.csv", [f"{i / 30:.3f}" for i in range(300)], x, rate=60.0)
    assert np.array_equal(flight.inputs["u"][::2], x[: flight.inputs["u"][::2].size])


@pytest.mark.parametrize("rate", [20.0, 250.0, 60.0])
def test_notes_of_resampling(tmp_path, rate):
    flight = read(tmp_path / "log.csv", [f"{0.01 * i:.2f}" for i in range(100)], rate=rate)
    assert "resampling.rate" in notes(flight)
    assert ("resampling.low-passed" in notes(flight)) == (rate < 100.0)
    assert ("resampling.slower" in notes(flight)) == (rate == 250.0)
    assert flight.dt == 1 / rate
    assert flight.duration == pytest.approx(0.99, abs=flight.dt)


STEPS = st.lists(st.integers(1, 50), min_size=2, max_size=40)


@settings(deadline=None)
@given(steps=STEPS, every=st.integers(1, 30))
def test_hold_and_interpolation_against_a_plain_loop(steps, every):
    ticks = [0, *np.cumsum(steps).tolist()]
    values = np.random.default_rng(len(ticks)).normal(size=len(ticks))
    new = list(range(0, ticks[-1] + 1, every))
    seconds, times = np.array(ticks) * 1e-3, np.array(new) * 1e-3
    held, line = [], []
    for tick in new:
        k = bisect_right(ticks, tick) - 1
        after = min(k + 1, len(ticks) - 1)
        part = (tick - ticks[k]) / max(ticks[after] - ticks[k], 1)
        held.append(values[k])
        line.append(values[k] + part * (values[after] - values[k]))
    assert np.array_equal(hold(seconds, values, times), held)
    assert np.allclose(interpolate(seconds, values, times), line, rtol=0, atol=1e-9)


@settings(deadline=None)
@given(steps=STEPS, every=st.integers(1, 30))
def test_mean_of_a_held_input_against_a_count_of_ticks(steps, every):
    ticks = [0, *np.cumsum(steps).tolist()]
    values = np.random.default_rng(len(ticks)).normal(size=len(ticks))
    count = max(2, ticks[-1] // every + 1)
    by_tick = [values[bisect_right(ticks, t) - 1] for t in range(count * every)]
    mean = np.reshape(by_tick, (count, every)).mean(axis=1)
    times = np.arange(count) * every * 1e-3
    assert held_mean(np.array(ticks) * 1e-3, values, times) == pytest.approx(mean, abs=1e-9)


def test_a_held_input_on_its_own_grid_stays_to_the_last_bit():
    values = np.random.default_rng(3).normal(size=5000) * 1e300
    seconds = 1.7e9 + np.arange(5000) / 100
    assert np.array_equal(held_mean(seconds, values, seconds[0] + np.arange(5000) * 0.01), values)
    # Ten samples per step of the grid, all with one value.
    held = np.repeat(values[:500], 10)
    assert np.array_equal(held_mean(seconds, held, seconds[::10]), values[:500])


def test_a_flight_at_a_lower_rate_keeps_the_impulse_of_its_stick(tmp_path):
    rows = [(0.01 * i, 1.0 if i >= 53 else 0.0) for i in range(100)]
    text = "t,stick,phi\n" + "".join(f"{t:.2f},{u},{t}\n" for t, u in rows)
    (tmp_path / "log.csv").write_text(text)
    flight = read_flight(
        tmp_path / "log.csv",
        time="t",
        rate=20.0,
        inputs={"x_roll": Signal("stick", "m", "m", hold="zero-order")},
        outputs={"roll": Signal("phi", "rad", "rad")},
    )
    # After the step at 0.53 s, 0.02 s of the grid's step from 0.5 s remain.
    expected = [0.0] * 10 + [0.4] + [1.0] * 9
    assert flight.inputs["x_roll"] == pytest.approx(expected, abs=1e-9)
