"""Runs with gaps too long to bridge, split into parts."""

import numpy as np
import pytest
import yaml

from heli_jax import config
from heli_jax.errors import InputError
from heli_jax.finding import LEFT_OUT
from heli_jax.flights import Signal, read_flight, read_parts
from heli_jax.flights.parts import stretches

from .test_configured_logs import BENCH

SIGNALS = {
    "inputs": {"x_roll": Signal("u", "1", "1")},
    "outputs": {"roll": Signal("y", "1", "1"), "slow": Signal("s", "1", "1")},
}


def run(tmp_path, *gaps, until=20.0):
    """Write a table of 50 Hz without the rows within the gaps (first, last) [s]."""
    t = np.arange(round(50 * until)) / 50
    t = t[[not any(a < x < b for a, b in gaps) for x in t]]
    slow = np.where(np.rint(50 * t) % 50 == 0, t, np.nan)
    rows = [
        f"{a:.2f},{float(np.sin(a))!r},{float(np.cos(a))!r},{'' if np.isnan(s) else s}"
        for a, s in zip(t, slow, strict=True)
    ]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(["t,u,y,s", *rows]))
    return path


def test_a_run_is_split_at_its_gaps(tmp_path):
    path = run(tmp_path, (8.99, 12.01), (13.0, 15.0))
    with pytest.raises(InputError):
        read_flight(path, time="t", **SIGNALS)
    first, second = read_parts(path, time="t", **SIGNALS, name="hover")
    assert (first.name, second.name) == ("hover, part 1", "hover, part 2")
    assert (first.t0, second.t0) == (0.0, 15.0)
    assert (first.duration, second.duration) == pytest.approx((8.98, 4.98))
    np.testing.assert_allclose(second.outputs["roll"], np.cos(15.0 + second.times), atol=1e-12)
    # One second between two gaps is left out, with a note.
    (note,) = [n for n in first.source.notes if n.code == "windows.left-out"]
    assert note.value == 1
    # A part with five samples of the slow output is fitted without it.
    assert "slow" in first.outputs
    assert "slow" not in second.outputs
    assert [n.subjects for n in second.source.notes if n.code == LEFT_OUT] == [("slow",)]


@pytest.mark.parametrize(
    ("gaps", "parts"),
    [
        # One row after the last gap, before the first, or between two.
        ([(8.99, 19.97)], [0.0]),
        ([(0.0, 9.0)], [9.0]),
        ([(5.0, 10.0), (10.0, 15.0)], [0.0, 15.0]),
    ],
)
def test_a_lone_row_is_left_out(tmp_path, gaps, parts):
    read = read_parts(run(tmp_path, *gaps), time="t", **SIGNALS)
    assert [f.t0 for f in read] == pytest.approx(parts)
    assert "windows.left-out" in {n.code for n in read[0].source.notes}


def test_a_run_without_gaps_stays_one(tmp_path):
    path = run(tmp_path, until=10.0)
    (whole,) = read_parts(path, time="t", **SIGNALS, name="hover")
    assert whole.name == "hover"
    assert whole.n_samples == read_flight(path, time="t", **SIGNALS).n_samples


def test_nothing_left_is_an_error(tmp_path):
    path = run(tmp_path, (1.0, 4.0), until=5.0)
    with pytest.raises(InputError):
        read_parts(path, time="t", **SIGNALS)


def test_gaps_of_several_clocks():
    fast, slow = np.arange(0, 10, 0.01), np.arange(0.3, 9, 0.1)
    fast = fast[(fast < 4) | (fast > 5.995)]
    slow = slow[(slow < 3) | (slow > 4.95)]
    (first, second) = stretches([fast, slow])
    assert first == pytest.approx((0.3, 2.9))
    assert second == pytest.approx((6.0, 8.9))


def test_by_configuration(tmp_path):
    path = run(tmp_path, (8.99, 12.01), (13.0, 15.0))
    content = yaml.safe_load(BENCH.read_text())
    content["vehicle"] = str((BENCH.parent / content["vehicle"]).resolve())
    signals = {
        "time": {"signal": "t"},
        "inputs": {"x_roll": {"signal": "u", "unit": "m"}},
        "outputs": {"roll": {"signal": "y", "unit": "rad"}},
    }
    flight = {"log": path.name, "signals": signals, "gaps": "split"}
    content["flights"] = [flight]
    (tmp_path / "flight.yaml").write_text(yaml.safe_dump(content))
    flights = config.read_flights(config.load(tmp_path / "flight.yaml"))
    assert [f.name for f in flights] == ["flight 1, part 1", "flight 1, part 2"]


def test_an_input_acts_in_a_short_gap_too(tmp_path):
    """Test a fast log with a short gap, resampled to a lower rate."""
    t = np.r_[0.0, 0.16 + np.arange(1600) / 400]
    np.savez(tmp_path / "a.npz", t=t, u=np.sin(3.0 * t), p=np.cos(3.0 * t))
    f = read_flight(
        tmp_path / "a.npz",
        inputs={"u": Signal("u", "1", "1")},
        outputs={"p": Signal("p", "1", "1")},
        time="t",
        rate=100,
    )
    assert np.isfinite(f.inputs["u"]).all()
    assert np.max(np.abs(f.inputs["u"] - np.sin(3.0 * f.times))) < 0.05
    assert np.isnan(f.outputs["p"]).any()


def test_a_step_in_lost_samples_is_late_by_nothing_on_average():
    from heli_jax.flights.resample import with_lost

    rng = np.random.default_rng(4)
    u = np.repeat(rng.uniform(-1.0, 1.0, 500), 10)
    kept = rng.uniform(size=u.size) > 0.2
    kept[[0, -1]] = True
    stamps = 0.02 * np.arange(u.size)
    seconds, restored = with_lost(stamps[kept], u[kept])
    assert seconds == pytest.approx(stamps, abs=1e-9)
    assert restored[kept] == pytest.approx(u[kept])
    # Regression on the input's own steps: its delay in samples.
    steps = -np.gradient(u)
    assert abs((restored - u) @ steps / (steps @ steps)) < 0.03
    late = u[np.maximum.accumulate(np.where(kept, np.arange(u.size), 0))]
    assert (late - u) @ steps / (steps @ steps) > 0.1
    # A log of changes has no regular clock.
    changes = np.cumsum(rng.exponential(0.3, 400))
    assert with_lost(changes, u[:400])[0] is changes
