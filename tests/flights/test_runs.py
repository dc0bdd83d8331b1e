"""Several runs in one table become separate flights."""

from pathlib import Path

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import Signal, read_flight, read_parts
from heli_jax.flights.clock import by_rate, restarts
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.describe import describe_log

DT, SIZES = 0.02, (150, 120, 200)
RUN = np.repeat([1, 2, 3], SIZES)
T = np.concatenate([DT * np.arange(n) for n in SIZES])
U = np.sign(np.sin(9.0 * T)) * RUN
P = 0.1 * np.sin(3.0 * T) + RUN
SIGNALS = {"inputs": {"u": Signal("u", "1", "1")}, "outputs": {"p": Signal("p", "1", "1")}}


def written(path: Path, **columns: np.ndarray) -> Path:
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def check(parts) -> None:
    assert [f.n_samples for f in parts] == list(SIZES)
    for i, f in enumerate(parts, 1):
        assert f.dt == pytest.approx(DT)
        np.testing.assert_allclose(f.outputs["p"], P[i == RUN], atol=1e-8)
        np.testing.assert_allclose(f.inputs["u"], U[i == RUN])


def test_a_time_that_begins_anew_begins_a_flight(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", t=T, u=U, p=P)
    parts = read_parts(path, time="t", **SIGNALS)
    check(parts)
    assert parts[0].source is not None
    assert [n.value for n in parts[0].source.notes if n.code == "clock.runs"] == [3]
    with pytest.raises(InputError):
        read_flight(path, time="t", **SIGNALS)


def test_a_column_numbers_runs_of_a_time_that_goes_on(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", run=RUN, t=DT * np.arange(T.size), u=U, p=P)
    check(read_parts(path, time="t", runs="run", **SIGNALS))
    check(read_parts(path, time=by_rate(1 / DT), runs="run", **SIGNALS))
    info = describe_log(path)
    assert info.time is not None
    assert info.time.runs == 1
    # Without the split, several flights would become one.
    assert read_flight(path, time="t", **SIGNALS).n_samples == T.size


def test_info_and_convert_put_them_apart_and_say_so(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", time_ms=1000 * T, u=U, p=P)
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.runs, len(info.time.gaps)) == (3, 2)
    assert info.time.duration == pytest.approx(DT * (T.size - 3) + 20)
    converted = convert_log(path, Selection())
    assert np.diff(converted.columns["time"]).max() == pytest.approx(10.0)
    assert [n.value for n in converted.notes if n.code == "clock.runs"] == [3]


def test_a_wrong_stamp_is_no_missing_sample(tmp_path: Path) -> None:
    t = DT * np.arange(200)
    t[50] = 5e9
    log = describe_log(written(tmp_path / "log.csv", t=t, p=np.sin(t)))
    assert "samples.marks" not in {n.code for n in log.notes}
    assert log.time is not None
    assert "runs backwards" in log.time.problem


def test_what_is_no_new_run(tmp_path: Path) -> None:
    times = DT * np.arange(200)
    assert not restarts(times).size
    for change in (
        lambda t: t[50:51].fill(0.1),  # one stamp goes back
        lambda t: t[50:51].fill(5e9),  # all stamps go back from one on
        lambda t: t[50:51].fill(-1e300),
        lambda t: t[100:].__isub__(0.5),  # a clock that was set back
        lambda t: t.__setitem__(slice(None), np.sin(9 * t)),
        lambda t: t[190:].__isub__(3.8),  # too short for a run
    ):
        stamps = times.copy()
        change(stamps)
        assert not restarts(stamps).size
