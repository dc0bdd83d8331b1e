"""Stamps that count as a uniform grid, and resampling of the others."""

from bisect import bisect_right

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, dlsim

from heli_jax.errors import InputError
from heli_jax.flights import Flight, Signal, read_flight
from heli_jax.flights.holds import Decision, is_low_passed
from heli_jax.flights.onto_grid import at_times
from heli_jax.flights.request import ReadOptions, Request
from heli_jax.flights.resample import Timed, held_mean, hold, interpolate


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
    # The last value would make a step in the lost sample late.
    assert np.allclose(flight.inputs["u"], want, atol=1e-9)
    assert "resampling.lost" in notes(flight)


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


def _heave(tmp_path, fine, rate, follows):
    """Return a flight of a heaving rotor with inflow, and its response to the logged stick.

    The flight is at `rate` [Hz], from a log of `fine` [Hz] whose stick jumps. Outputs are
    acceleration and vertical rate.
    """
    A, B = np.array([[-0.55, 6.0], [0.0, -1 / 0.11]]), np.array([[-28.0], [1.26 / 0.11]])
    # The acceleration, and its integral.
    C, D = np.array([[-0.55, 6.0], [1.0, 0.0]]), np.array([[-28.0], [0.0]])
    draw, u = np.random.default_rng(5), np.zeros(30 * fine)
    at = fine
    while at < 29 * fine:
        stay = int(draw.uniform(0.1, 0.9) * fine)
        u[at : at + stay] = draw.uniform(-1, 1)
        at += stay
    u[29 * fine :] = 0.0
    held = cont2discrete((A, B, C, D), 1 / fine, "zoh")
    y = dlsim(held, u)[1]
    seconds = np.arange(u.size) / fine
    table = np.column_stack([seconds, u, y])
    np.savetxt(tmp_path / "heave.csv", table, "%.12g", ",", header="t,u,a,w", comments="")
    flight = read_flight(
        tmp_path / "heave.csv",
        time="t",
        rate=float(rate),
        inputs={"col": Signal("u", "1", "1", hold="zero-order")},
        outputs={"az": Signal("a", "m/s^2", "m/s^2"), "w": Signal("w", "m/s", "m/s")},
        follows=follows,
    )
    kind = "zoh" if flight.hold["col"] == "zero-order" else "foh"
    # scipy's triangle hold changes the state; only its output is valid.
    made = dlsim(cont2discrete((A, B, C, D), 1 / rate, kind), flight.inputs["col"])[1].T
    inside = slice(2 * rate, -2 * rate)
    error = {
        n: float(np.std((flight.outputs[n] - m)[inside]) / np.std(flight.outputs[n][inside]))
        for n, m in zip(("az", "w"), made, strict=True)
    }
    return flight, error


@pytest.mark.parametrize(("fine", "rate"), [(100, 40), (200, 50), (100, 20)])
def test_an_acceleration_and_its_stick_are_filtered_alike(tmp_path, fine, rate):
    flight, error = _heave(tmp_path, fine, rate, {("col", "az"): True})
    assert error["az"] < 0.008
    # The integral equals that with the mean of each step.
    assert error["w"] < 0.004
    assert flight.hold == {"col": "linear"}
    assert is_low_passed(flight, "col")
    held, before = _heave(tmp_path, fine, rate, {})
    assert before["az"] > 0.1
    assert held.hold == {"col": "zero-order"}
    assert not is_low_passed(held, "col")


def test_an_acceleration_that_is_no_faster_than_the_grid_cannot_follow_a_faster_stick():
    t, slow = np.arange(800) / 200, np.arange(200) / 50
    signals = {
        ("col", "input"): Timed(t, np.sign(np.sin(7.3 * t))),
        ("az", "output"): Timed(slow, np.cos(slow)),
    }
    stick = {"col": Signal("u", "1", "1", hold="zero-order")}
    options = ReadOptions(rate=50.0, follows={("col", "az"): True})
    request = Request("log", None, stick, {"az": Signal("a", "1", "1")}, options)
    made = at_times(request, signals, {"col": Decision("zero-order", "")}, slow)
    assert made.holds["col"].hold == "zero-order"
