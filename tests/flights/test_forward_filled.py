"""Joins of topics that were filled forward: what is carried on is no measurement."""

import numpy as np
import pandas as pd
import pytest

from heli_jax import Signal
from heli_jax.flights import read_flight
from heli_jax.flights.repeats import carried_on, first_of_each
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
    """A gyro at 100 Hz, an angle at 50 Hz and a stick at 50 Hz, in the rows of all three."""
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


def test_what_a_forward_filled_join_carries_on_is_no_measurement(joined, tmp_path):
    joined.ffill().to_csv(tmp_path / "filled.csv")
    read = flight(tmp_path / "filled.csv", rate=100.0)
    assert read.source is not None
    repeated = [n.subjects for n in read.source.notes if n.code.startswith("repeats.")]
    assert ("p",) in repeated
    t = read.t0 + read.times
    for name, true, count in (("p", rate, 3000),):
        seen = np.isfinite(read.outputs[name])
        assert seen.sum() == pytest.approx(count, rel=0.01)
        np.testing.assert_allclose(np.std(read.outputs[name][seen] - true(t[seen])), 0.01, rtol=0.2)


def test_samples_of_the_grid_s_own_rate_stay_as_they_were_measured(joined, tmp_path):
    # A mean of two neighbours would have less noise, and not white.
    joined.to_csv(tmp_path / "joined.csv")
    read = flight(tmp_path / "joined.csv", rate=100.0)
    measured = joined["gyro_x"].dropna()
    at = np.searchsorted(measured.index, read.t0 - 1e-6)
    np.testing.assert_allclose(
        read.outputs["p"], measured.to_numpy()[at : at + read.n_samples], rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("filled", [False, True])
def test_new_takes_the_rate_of_the_outputs_and_not_that_of_the_rows(joined, filled, tmp_path):
    table = joined.ffill() if filled else joined
    table.rename_axis("time_s").to_csv(tmp_path / "log.csv")
    write_config(tmp_path / "log.csv", tmp_path / "c.yaml", "linear:roll-flybarless")
    words = (tmp_path / "c.yaml").read_text()
    assert "    rate: 100 " in words


def test_what_carries_on_is_told_by_the_resolution(joined):
    t = joined.index.to_numpy()
    full = joined.ffill()
    for name in "gyro_x", "roll":
        assert carried_on(t, full[name].to_numpy())
        np.testing.assert_array_equal(first_of_each(full[name].to_numpy()), joined[name].to_numpy())
        assert not carried_on(t, joined[name].to_numpy())
    # A command in steps stays as well, at its own values and for any time.
    assert not carried_on(t, full["aileron_cmd"].to_numpy())
    s = np.arange(6000) / 100
    rng = np.random.default_rng(3)
    steps = np.repeat(rng.standard_normal(900), rng.integers(1, 40, 900))[: s.size]
    assert not carried_on(s, steps)
    # Coarse counts repeat by chance, and rows that were lost now and then are not a join.
    assert not carried_on(s, np.round(20.0 * noisy(rate, 4)(s)))
    assert not carried_on(s, np.round(rate(0.1 * s), 3))
    some = np.where(rng.random(s.size) < 0.1, np.nan, noisy(rate, 5)(s))
    assert not carried_on(s, pd.Series(some).ffill().bfill().to_numpy())


def test_a_lone_output_that_keeps_each_value_for_one_length_needs_no_other_sign(tmp_path):
    t = np.arange(6000) / 100
    held = noisy(lambda s: np.sin(0.7 * s), 6)(t)[np.arange(6000) // 20 * 20]
    # In whole centimetres a second at rest the same value is measured again.
    for w in held, np.round(100.0 * np.where(t < 9, 0.0, held)):
        pd.DataFrame({"t": t, "col": stick(t), "w": w}).to_csv(tmp_path / "gps.csv", index=False)
        stated = {n: Signal(n, "1", "1") for n in ("col", "w")}
        read = read_flight(
            tmp_path / "gps.csv", time="t", inputs={"col": stated["col"]},
            outputs={"w": stated["w"]},
        )  # fmt: skip
        seen = np.flatnonzero(np.isfinite(read.outputs["w"]))
        assert np.array_equal(seen, np.arange(0, 6000, 20))
        assert read.source is not None
        assert [n.value for n in read.source.notes if n.code == "repeats.missing"] == [20]
