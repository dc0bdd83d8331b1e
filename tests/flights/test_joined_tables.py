"""Tables whose rows contain one topic each: every column has its own rows' times."""

import numpy as np
import pandas as pd
import pytest

from heli_jax import Signal
from heli_jax.errors import InputError
from heli_jax.flights import read_flight
from heli_jax.flights.convert import Selection, convert_log

END = 20.0


def gyro(t):
    return np.sin(2 * np.pi * 1.3 * t)


def speed(t):
    return np.sin(0.5 * t)


def stick(t):
    return np.sign(np.sin(t))


def topic(step, start, jitter=0.0, **columns):
    t = np.arange(start, END, step)
    t = t + jitter * step * np.random.default_rng(1).uniform(-0.5, 0.5, t.size)
    t = np.round(t, 6)
    return pd.DataFrame({n: f(t) for n, f in columns.items()}, index=pd.Index(t, name="t"))


@pytest.fixture(params=[0.0, 0.2])
def path(request, tmp_path):
    """Return pandas' outer merge of a gyro at 400 Hz, sticks at 50 Hz and a GPS at 5 Hz.

    Some of the stamps coincide.
    """
    fast = topic(1 / 400, 0.0, request.param, p=gyro, q=np.cos)
    merged = fast.join(topic(0.02, 0.0, lat=stick), how="outer")
    merged = merged.join(topic(0.2, 0.0031, v=speed), how="outer")
    merged.to_csv(tmp_path / "joined.csv")
    return tmp_path / "joined.csv"


def flight(path, inputs=("lat",), outputs=("p", "v"), **options):
    return read_flight(
        path,
        time="t",
        inputs={n: Signal(n, "1", "1") for n in inputs},
        outputs={n: Signal(n, "rad/s", "rad/s") for n in outputs},
        **options,
    )


def test_convert_takes_each_column_at_its_own_rows(path):
    converted = convert_log(path, Selection(rate=50.0))
    t = converted.columns["time"]
    first = pd.read_csv(path)["t"][0]
    for name, true, most in (("p", gyro, 2e-3), ("q", np.cos, 1e-4), ("v", speed, 2e-3)):
        assert np.isfinite(converted.columns[name]).all()
        np.testing.assert_allclose(converted.columns[name], true(t + first), atol=most)
    assert np.mean(converted.columns["lat"] == stick(t + first)) > 0.98
    assert [n.value for n in converted.notes if n.code == "channels.joined"] == [3]


def test_without_a_rate_the_rows_stay_as_they_are(path):
    converted = convert_log(path, Selection())
    table = pd.read_csv(path)
    for name in "p", "lat", "v":
        np.testing.assert_array_equal(converted.columns[name], table[name])


def test_a_flight_takes_each_signal_at_its_own_rows(path):
    with pytest.raises(InputError):
        flight(path)
    read = flight(path, rate=50.0)
    t = read.t0 + read.dt * np.arange(read.n_samples)
    np.testing.assert_allclose(read.outputs["p"], gyro(t), atol=2e-3)
    assert np.isfinite(read.inputs["lat"]).all()
    # A slow output is missing between its own samples.
    seen = np.isfinite(read.outputs["v"])
    assert 95 <= seen.sum() <= 100
    np.testing.assert_allclose(read.outputs["v"][seen], speed(t[seen]), atol=1e-3)
    assert read.source is not None
    assert "channels.joined" in {n.code for n in read.source.notes}
    part = flight(path, rate=50.0, window=(5.0, 15.0))
    assert part.duration == pytest.approx(10.0, abs=0.05)


def test_one_topic_of_a_joined_table_needs_no_rate(tmp_path):
    fast, slow = topic(1 / 400, 0.0, p=gyro, lat=stick), topic(0.2, 0.0031, v=speed)
    fast.join(slow, how="outer").to_csv(tmp_path / "joined.csv")
    read = flight(tmp_path / "joined.csv", outputs=("p",))
    assert (read.dt, read.n_samples) == (pytest.approx(1 / 400), len(fast))
    np.testing.assert_array_equal(read.outputs["p"], fast["p"])


def test_a_stick_that_lacks_a_sample_here_and_there_is_refused_as_before(tmp_path):
    whole = topic(0.01, 0.0, lat=stick, p=gyro)
    whole.loc[whole.index[500], "lat"] = np.nan
    whole.to_csv(tmp_path / "log.csv")
    with pytest.raises(InputError, match="line 502, column 'lat': got nothing"):
        flight(tmp_path / "log.csv", outputs=("p",))


def filled(path, lat):
    """Return a table in which every cell has the last value, if there is one."""
    rows = pd.DataFrame({"t": 0.01 * np.arange(200), "lat": lat, "p": np.arange(200.0)})
    rows.to_csv(path, index=False)
    return path


def test_an_input_that_is_empty_within_or_everywhere_is_refused(tmp_path):
    lat = np.sin(np.arange(200.0))
    lat[100] = np.nan
    with pytest.raises(InputError, match="line 102, column 'lat'"):
        flight(filled(tmp_path / "log.csv", lat), outputs=("p",))
    with pytest.raises(InputError):
        flight(filled(tmp_path / "all.csv", np.full(200, np.nan)), outputs=("p",))
