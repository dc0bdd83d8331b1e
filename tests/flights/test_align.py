"""Two logs of one flight, aligned by a motion that both contain."""

import dataclasses

import numpy as np
import pytest
import yaml

from heli_jax import config
from heli_jax.errors import InputError
from heli_jax.flights import Also, Signal, read_flight
from heli_jax.flights.align import NotAligned, lag_between
from heli_jax.flights.resample import Timed

from .test_configured_logs import BENCH


def motion(seed, fastest=2.0):
    """Return a random motion of limited band, as a function of time."""
    rng = np.random.default_rng(seed)
    w, phase = 2 * np.pi * rng.uniform(0.05, fastest, 60), rng.uniform(0, 6.3, 60)
    return lambda t: 0.3 * np.sin(np.multiply.outer(t, w) + phase).mean(axis=-1)


def pair(seed, lag, rates=(100, 50), noise=(0.02, 0.02)):
    """Return the same motion on two clocks, the second late by `lag` [s]."""
    rng, x = np.random.default_rng(seed), motion(seed)
    t = [np.arange(a * f, b * f) / f for (a, b), f in zip([(0, 40), (8, 35)], rates, strict=True)]
    t = [s + rng.uniform(-0.1, 0.1, s.size) / f for s, f in zip(t, rates, strict=True)]
    a, b = (
        x(s) + n * np.std(x(s)) * rng.standard_normal(s.size) for s, n in zip(t, noise, strict=True)
    )
    return Timed(t[0], a), Timed(t[1] - lag, 57.3 * b + 2.0)


def test_lags_are_found_to_a_part_of_a_sample():
    """Test 6 records; experiments/alignment.py has more, with other rates and noise."""
    for seed in range(6):
        lag = np.random.default_rng(seed + 99).uniform(-5, 5) + 1.6e9 * (seed % 2)
        found = lag_between(*pair(seed, lag))
        assert found.correlation > 0.99
        # At 1.6e9 s float64 resolves 200 ns, so an epoch costs no accuracy.
        assert found.lag == pytest.approx(lag, abs=2e-3)


def signal(t, x):
    return Timed(t, np.asarray(x, float))


def test_what_cannot_be_told_is_refused():
    t = np.arange(2000) / 50
    rng = np.random.default_rng(0)
    noise = [signal(t, rng.standard_normal(t.size)) for _ in range(2)]
    with pytest.raises(NotAligned, match="hardly correlated"):
        lag_between(*noise)
    waves = [signal(t, np.sin(6 * t) + 0.1 * rng.standard_normal(t.size)) for _ in range(2)]
    with pytest.raises(NotAligned, match="fit nearly equally"):
        lag_between(*waves)
    x = motion(3)(t)
    with pytest.raises(NotAligned, match="opposite signs"):
        lag_between(signal(t, x), signal(t, -x))
    with pytest.raises(NotAligned, match="expected at least 40"):
        lag_between(signal(t, x), signal(t[:20], x[:20]))
    with pytest.raises(NotAligned, match="too short, or move too little"):
        lag_between(signal(t, x), signal(t, np.zeros(t.size)))


def written(tmp_path):
    """Write sticks and p at 100 Hz, and roll and p of a motion capture at 30 Hz."""
    x, t, s = motion(5), np.arange(4000) / 100, 7.0 + np.arange(900) / 30
    table = np.stack([t, np.sin(t), x(t)], axis=1)
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,u,p", comments="")
    table = np.stack([1.6e9 + 12.3456 + s, 0.5 * s, -57.3 * x(s)], axis=1)
    table[400:403, 2] = -9999.0  # a mark for a missing value, not a motion
    fmt = ["%.6f", "%.9g", "%.9g"]
    np.savetxt(
        tmp_path / "mocap.csv", table, delimiter=",", header="at,phi,q", comments="", fmt=fmt
    )


def test_two_files_make_one_flight(tmp_path):
    written(tmp_path)
    also = Also(
        str(tmp_path / "mocap.csv"),
        "roll_rate",
        "q",
        outputs={"roll": Signal("phi", "rad", "rad")},
        time=Signal("at", "s", "s"),
        reverse=True,
    )
    asked = {
        "time": "t",
        "inputs": {"x_roll": Signal("u", "1", "1")},
        "outputs": {"roll_rate": Signal("p", "rad/s", "rad/s")},
    }
    flight = read_flight(tmp_path / "log.csv", **asked, rate=100.0, window=(5, 30), also=(also,))
    assert flight.n_samples == 2501
    seen = np.isfinite(flight.outputs["roll"])
    # Slower than the grid: a third of its instants, from 7 s on.
    assert seen.sum() == pytest.approx(23 * 30, abs=2)
    at = 5.0 + flight.times[seen]
    assert at[0] == pytest.approx(7.0, abs=6e-3)
    np.testing.assert_allclose(flight.outputs["roll"][seen], 0.5 * at, atol=2e-3)
    assert flight.source is not None
    (found,) = [n for n in flight.source.notes if n.code == "clock.aligned"]
    assert found.value == pytest.approx(7.0, abs=3e-4)
    wrong = dataclasses.replace(also, same="yaw")
    with pytest.raises(InputError):
        read_flight(tmp_path / "log.csv", **asked, rate=100.0, also=(wrong,))
    wrong = dataclasses.replace(also, reverse=False)
    with pytest.raises(InputError):
        read_flight(tmp_path / "log.csv", **asked, rate=100.0, also=(wrong,))


def test_by_configuration(tmp_path):
    written(tmp_path)
    content = yaml.safe_load(BENCH.read_text())
    content["vehicle"] = str((BENCH.parent / content["vehicle"]).resolve())
    also = {
        "log": "mocap.csv",
        "align": {"with": "roll_rate", "to": "q", "reverse": True},
        "signals": {
            "time": {"signal": "at"},
            "outputs": {"roll": {"signal": "phi", "unit": "rad"}},
        },
    }
    signals = {
        "time": {"signal": "t"},
        "inputs": {"x_roll": {"signal": "u", "unit": "m"}},
        "outputs": {"roll_rate": {"signal": "p", "unit": "rad/s"}},
    }
    flight = {"log": "log.csv", "rate": 100, "signals": signals, "also": [also]}

    def read(flight):
        content["flights"] = [flight]
        (tmp_path / "flight.yaml").write_text(yaml.safe_dump(content))
        return config.read_flights(config.load(tmp_path / "flight.yaml"))

    (made,) = read(flight)
    # As in a run's resolved configuration, which is repeated from another folder.
    written_out = config.resolved(config.load(tmp_path / "flight.yaml"))["flights"][0]["also"][0]
    assert written_out["log"] == str((tmp_path / "mocap.csv").resolve())
    assert written_out["align"] == also["align"]
    assert list(made.outputs) == ["roll_rate", "roll"]
    also["signals"]["outputs"]["roll_rate"] = {"signal": "q", "unit": "deg/s"}
    with pytest.raises(InputError):
        read(flight)


def one_clock(tmp_path, begins):
    """Write sticks and rates, and the attitude in a separate file that starts at `begins` [s]."""
    x = motion(3)
    t, late = 5.0 + np.arange(3000) / 100, begins + np.arange(1200) / 50
    rows = [f"{a:.3f},{np.sign(b):.1f},{b:.9f}" for a, b in zip(t, x(t), strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["t,u,p", *rows]))
    rows = [f"{1e3 * a:.1f},{b:.9f}" for a, b in zip(late, x(late), strict=True)]
    (tmp_path / "also.csv").write_text("\n".join(["ms,phi", *rows]))
    also = Also(
        str(tmp_path / "also.csv"),
        outputs={"phi": Signal("phi", "rad", "rad")},
        time=Signal("ms", "ms", "s"),
    )
    return x, read_flight(
        tmp_path / "log.csv",
        time="t",
        inputs={"u": Signal("u", "1", "1")},
        outputs={"p": Signal("p", "rad/s", "rad/s")},
        rate=50.0,
        also=(also,),
    )


def test_a_second_file_on_the_same_clock_needs_no_alignment(tmp_path):
    x, flight = one_clock(tmp_path, 8.0)
    t = flight.t0 + flight.dt * np.arange(flight.n_samples)
    np.testing.assert_allclose(flight.outputs["phi"], x(t), atol=1e-3)
    assert flight.t0 == pytest.approx(8.0, abs=0.03)
    assert flight.source is not None
    assert "clock.taken-as-one" in {n.code for n in flight.source.notes}


def test_a_second_file_on_another_clock_is_refused(tmp_path):
    with pytest.raises(InputError):
        one_clock(tmp_path, 1000.0)
