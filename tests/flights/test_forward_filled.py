"""Joined topics: outputs keep only measured samples."""

import numpy as np
import pandas as pd
import pytest

from heli_jax import Signal
from heli_jax.flights import read_flight
from heli_jax.new_config import write_config

END = 30.0


def noisy(f, seed):
    rng = np.random.default_rng(seed)
    return lambda t: f(t) + 0.01 * rng.standard_normal(t.size)


def rate(t):
    return np.sin(2 * np.pi * 1.3 * t)


def angle(t):
    return -np.cos(2 * np.pi * 1.3 * t) / (2 * np.pi * 1.3)


def stick(t):
    return np.sign(np.sin(2.3 * t))


def column(name, hz, start, f):
    t = np.round(np.arange(start, END, 1 / hz), 6)
    return pd.DataFrame({name: f(t)}, index=pd.Index(t, name="t"))


@pytest.fixture
def joined():
    """Return a gyro at 100 Hz, an angle and a stick at 50 Hz, joined in common rows."""
    table = column("gyro_x", 100, 0.0021, noisy(rate, 1))
    table = table.join(column("roll", 50, 0.0013, noisy(angle, 2)), how="outer")
    return table.join(column("aileron_cmd", 50, 0.0041, stick), how="outer")


def flight(path, **options):
    repeats = options.pop("repeats", "auto")
    return read_flight(
        path,
        time="t",
        inputs={"lat": Signal("aileron_cmd", "1", "1")},
        outputs={
            "p": Signal("gyro_x", "rad/s", "rad/s", repeats=repeats),
            "phi": Signal("roll", "rad", "rad", repeats=repeats),
        },
        **options,
    )


def test_samples_of_the_grid_s_own_rate_stay_as_they_were_measured(joined, tmp_path):
    # A mean of two neighbours would have less noise, and not white.
    joined.to_csv(tmp_path / "joined.csv")
    read = flight(tmp_path / "joined.csv", rate=100.0)
    measured = joined["gyro_x"].dropna()
    at = np.searchsorted(measured.index, read.t0 - 1e-6)
    np.testing.assert_allclose(
        read.outputs["p"], measured.to_numpy()[at : at + read.n_samples], rtol=0, atol=1e-9
    )


def test_new_takes_the_rate_of_the_outputs_and_not_that_of_the_rows(joined, tmp_path):
    joined.rename_axis("time_s").to_csv(tmp_path / "log.csv")
    write_config(tmp_path / "log.csv", tmp_path / "c.yaml", "linear:roll-flybarless")
    words = (tmp_path / "c.yaml").read_text()
    assert "    rate: 100 " in words
