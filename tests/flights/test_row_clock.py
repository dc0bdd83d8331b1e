"""Logs without times: the rate at which their rows were sampled is stated, or in the file."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

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
    info = describe_log(path, rate=RATE)
    assert info.time is not None
    assert (info.time.column, len(info.time.gaps)) == ("Frame", 1)


@pytest.mark.parametrize(
    ("name", "number"), [("Ts", 0.025), ("dt", 0.025), ("fs", 40.0), ("sample_rate", 40.0)]
)
@pytest.mark.parametrize("turned", [False, True])
def test_a_single_number_in_the_file_is_its_rate(tmp_path: Path, name, number, turned) -> None:
    y = np.stack([P, 2 * P], axis=1)
    path = tmp_path / "z.mat"
    scipy.io.savemat(path, {"y": y.T if turned else y, "u": U, name: number})
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.counted, info.time.said) == (RATE, f"'{name}' = {number:g}")
    converted = convert_log(path, Selection())
    assert [n.value for n in converted.notes if n.code == "clock.rate-of-file"] == [40]
    assert read(path, by_rate(RATE), p="y[1]").outputs["p"][7] == pytest.approx(2 * P[7])


def test_of_two_rates_none_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "z.mat"
    scipy.io.savemat(path, {"u": U, "y": P, "Ts": 0.02, "fs": 40.0})
    assert describe_log(path).time is None


def test_in_a_table_the_rate_stands_in_one_row(tmp_path: Path) -> None:
    lines = written(tmp_path / "a.csv").read_text().splitlines()
    more = [
        f"{line},{'Ts' if i == 0 else '0.025' if i == 1 else ''}" for i, line in enumerate(lines)
    ]
    (tmp_path / "a.csv").write_text("\n".join(more) + "\n")
    info = describe_log(tmp_path / "a.csv")
    assert info.time is not None
    assert info.time.counted == RATE


def test_the_configuration_has_one_clock() -> None:
    assert TimeConfig(rate=50).signal is None
    for wrong in ({}, {"rate": 0}, {"rate": 50, "unit": "ms"}):
        with pytest.raises(ValueError, match=r"rate|signal"):
            TimeConfig(**wrong)
