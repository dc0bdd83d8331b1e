"""Logs without times, with a stated sample rate of the rows."""

from pathlib import Path

import numpy as np
import pytest

from heli_jax.config.schema import TimeConfig
from heli_jax.errors import InputError
from heli_jax.flights import Signal, read_flight
from heli_jax.flights.clock import by_rate
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.describe import describe_log

N, RATE = 400, 40.0
U = np.repeat([0.0, 1.0, 0.0, -1.0], N // 4)
P = np.sin(0.05 * np.arange(N))


def written(path: Path, head="u,p", columns=(U, P)) -> Path:
    rows = [",".join(f"{x:.9f}" for x in row) for row in np.stack(columns, axis=1)]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def read(path: Path, clock: Signal, u="u", p="p", **more):
    signals = {"inputs": {"u": Signal(u, "1", "1")}, "outputs": {"p": Signal(p, "1", "1")}}
    return read_flight(path, time=clock, **signals, **more)


def test_rows_are_samples_at_the_rate_that_is_stated(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv")
    f = read(path, by_rate(RATE))
    assert (f.n_samples, f.dt) == (N, pytest.approx(1 / RATE, rel=1e-12))
    np.testing.assert_allclose(f.outputs["p"], P, atol=1e-9)
    assert read(path, by_rate(RATE), window=(2.0, 3.0)).n_samples == 41
    info = describe_log(path)
    assert info.time is None
    info = describe_log(path, rate=RATE)
    assert info.time is not None
    assert (info.time.counted, info.time.duration) == (RATE, pytest.approx((N - 1) / RATE))
    columns = convert_log(path, Selection(time_rate=RATE)).columns
    np.testing.assert_allclose(columns["time"], np.arange(N) / RATE, atol=1e-12)
    assert list(columns) == ["time", "u", "p"]


def test_frames_that_were_lost_are_missed(tmp_path: Path) -> None:
    frames = np.delete(np.arange(N), slice(200, 240))
    path = written(tmp_path / "a.csv", "Frame,u,p", (frames, U[frames], P[frames]))
    with pytest.raises(InputError):
        read(path, by_rate(RATE, "Frame"))
    info = describe_log(path, "Frame", rate=RATE)
    assert info.time is not None
    assert (info.time.column, len(info.time.gaps)) == ("Frame", 1)


def test_the_configuration_has_one_clock() -> None:
    assert TimeConfig(rate=50).signal is None
    for wrong in ({}, {"rate": 0}, {"rate": 50, "unit": "ms"}):
        with pytest.raises(ValueError, match=r"rate|signal"):
            TimeConfig(**wrong)
