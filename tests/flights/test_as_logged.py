"""Facts of signals before resampling: limits, steps, marks for no value, wrapped angles."""

from types import SimpleNamespace

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights.flight import Signal
from heli_jax.flights.parts import part
from heli_jax.flights.read import read_flight
from heli_jax.identification.diagnostics.record import (
    saturation,
    stuck_outputs,
)

N, DT = 2000, 0.01
T = DT * np.arange(N)
RNG = np.random.default_rng(0)
STICK = np.repeat(RNG.uniform(-1, 1, N // 50), 50)
RATE = np.sin(1.7 * T) + np.sin(2.9 * T) + 0.02 * RNG.standard_normal(N)


def of(flight, sd=0.0):
    """Input of the diagnostics of signals."""
    noise = {f"one/{n}": sd for n in flight.outputs}
    return SimpleNamespace(flights=[("one", flight)], noise=noise)


def read(tmp_path, rate=None, unit="1", si="1", window=None, u=STICK, **outputs):
    names = ["t", "u", *outputs]
    rows = np.column_stack([T, u, *outputs.values()])
    path = tmp_path / "log.csv"
    np.savetxt(path, rows, "%.17g", ",", header=",".join(names), comments="")
    return read_flight(
        path,
        time="t",
        inputs={"u": Signal("u", "1", "1")},
        outputs={n: Signal(n, unit, si) for n in outputs},
        rate=rate,
        window=window,
    )


@pytest.mark.parametrize("rate", [None, 50.0, 33.0])
def test_flat_tops_are_seen_at_any_rate(tmp_path, rate):
    f = read(tmp_path, rate, p=np.clip(RATE, -1.0, 1.2))
    (found,) = saturation(of(f))
    assert (found.code, found.severity, found.denies) == ("quality.saturation", "doubt", True)
    assert found.value == pytest.approx(np.mean((RATE <= -1.0) | (RATE >= 1.2)), abs=1e-6)
    # The share refers to the part that is read.
    half = part(f, 0, f.n_samples // 2)
    assert half.source is not None
    low, high = half.source.facts["p", "output"].shares
    seen = RATE[: N // 2]
    assert low + high == pytest.approx(np.mean((seen <= -1.0) | (seen >= 1.2)), abs=0.01)


@pytest.mark.parametrize("rate", [None, 40.0])
def test_a_stuck_sensor_is_seen_at_any_rate(tmp_path, rate):
    held = np.where((T > 5) & (T < 9), RATE[500], RATE)
    f = read(tmp_path, rate, q=held, r=RATE)
    (found,) = stuck_outputs(of(f))
    assert found.severity == "doubt"
    assert found.value == pytest.approx(4.0, abs=0.03)
    assert not list(stuck_outputs(of(read(tmp_path, rate, r=RATE))))


def test_marks_for_no_value_are_missing_and_not_spread(tmp_path):
    y = RATE.copy()
    y[700:710], y[900] = -9999.0, 1e10
    f = read(tmp_path, 50.0, p=y)
    missing = np.where(np.abs(y) > 100, np.nan, y)
    np.testing.assert_array_equal(f.outputs["p"], read(tmp_path, 50.0, p=missing).outputs["p"])
    assert f.source is not None
    assert [n.value for n in f.source.notes if n.code == "samples.marks"] == [11]
    with pytest.raises(InputError):
        read(tmp_path, u=np.where((T > 3) & (T < 3.025), 65535.0, STICK), p=RATE)
    # Any number of marks: most rows of a 5 Hz sensor have no value.
    f = read(tmp_path, p=np.where(np.arange(N) % 20 == 0, RATE, -9999.0), q=RATE)
    np.testing.assert_array_equal(np.isfinite(f.outputs["p"]), np.arange(N) % 20 == 0)
    assert [n.value for n in f.source.notes if n.code == "samples.marks"] == [1900]
    # -9999 is not far from rotor speeds, but is the only negative value; 1e20 is not physical.
    speed = 6000 + 5500 * np.sin(0.4 * T)
    speed[500] = -9999.0
    f = read(tmp_path, p=speed, q=np.where(T > 8, 1e20, RATE))
    assert np.flatnonzero(np.isnan(f.outputs["p"])).tolist() == [500]
    np.testing.assert_array_equal(np.isnan(f.outputs["q"]), T > 8)
    # The same number among values of its size is a value.
    near = read(tmp_path, p=1e4 + 10 * np.round(RATE)).outputs["p"]
    assert np.isfinite(near).all()


@pytest.mark.parametrize("rate", [None, 50.0])
@pytest.mark.parametrize("low", [-180.0, 0.0])
def test_a_wrapped_heading_is_unwrapped_before_anything_else(tmp_path, rate, low):
    psi = 170 + 20 * T + 5 * np.sin(T)
    f = read(tmp_path, rate, "deg", "rad", psi=(psi - low) % 360 + low)
    smooth = read(tmp_path, rate, "deg", "rad", psi=psi)
    np.testing.assert_allclose(f.outputs["psi"], smooth.outputs["psi"], atol=1e-9)
    assert f.source is not None
    assert "angles.unwrapped" in {n.code for n in f.source.notes}
    assert smooth.source is not None
    assert "angles.unwrapped" not in {n.code for n in smooth.source.notes}
