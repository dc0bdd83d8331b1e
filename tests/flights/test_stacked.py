"""Stacked runs, (segment, sample, channel), in files of arrays."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from heli_jax.errors import InputError
from heli_jax.flights import Signal, describe_log
from heli_jax.flights.open_log import open_table
from heli_jax.flights.read import read_parts

RUNS, SAMPLES = 3, 300
T = 0.01 * np.arange(SAMPLES)
TIMES = np.tile(T, (RUNS, 1))
X = np.cumsum(np.random.default_rng(0).standard_normal((RUNS, SAMPLES, 2)), axis=1)
U = np.sign(np.sin(7.0 * TIMES + np.arange(RUNS)[:, None]))[:, :, None]


def written(folder: Path, ending: str, content: dict[str, np.ndarray]) -> Path:
    path = folder / f"runs{ending}"
    if ending == ".npz":
        np.savez(path, **content)
    elif ending == ".npy":
        np.save(path, next(iter(content.values())))
    elif ending == ".mat":
        scipy.io.savemat(path, content)
    else:
        h5py = pytest.importorskip("h5py", reason="h5py is not installed")
        with h5py.File(path, "w") as file:
            for name, values in content.items():
                file[name] = values
    return path


def flights(path: Path, u: str = "u", y: str = "x[1]", **options):
    inputs = {"lat": Signal(u, "1", "1")}
    outputs = {"p": Signal(y, "rad/s", "rad/s")}
    return read_parts(path, inputs=inputs, outputs=outputs, **options)


@pytest.mark.parametrize(
    ("ending", "content"),
    [
        (".npz", {"t": TIMES, "x": X, "u": U}),
        (".mat", {"t": TIMES, "x": X, "u": U}),
        (".h5", {"t": TIMES, "x": X, "u": U}),
        # One clock for all runs.
        (".npz", {"t": T, "x": X, "u": U}),
        # A single channel is a matrix.
        (".npz", {"t": TIMES, "x": X, "u": U[:, :, 0]}),
    ],
)
def test_each_segment_becomes_a_flight(tmp_path: Path, ending: str, content) -> None:
    read = flights(written(tmp_path, ending, content), time="t")
    assert len(read) == RUNS
    for k, flight in enumerate(read):
        np.testing.assert_array_equal(flight.outputs["p"], X[k, :, 1])
        np.testing.assert_array_equal(flight.inputs["lat"], U[k, :, 0])


def test_a_stack_without_times_needs_its_numbers(tmp_path: Path) -> None:
    path = written(tmp_path, ".npy", {"data": np.concatenate([X, U], axis=2)})
    rows = Signal("row number", "s", "s", scale=0.01)
    signals = {"u": "data[2]", "y": "data[1]"}
    read = flights(path, time=rows, runs="segment", **signals)
    assert [f.n_samples for f in read] == [SAMPLES] * RUNS
    np.testing.assert_array_equal(read[2].outputs["p"], X[2, :, 1])
    with pytest.raises(InputError):
        flights(path, time=rows, **signals)


def test_what_is_no_stack_is_named(tmp_path: Path) -> None:
    # Images, an inertia matrix and rotation matrices beside the signals of one run.
    others = {"img": np.ones((300, 8, 9)), "J": np.ones((3, 3, 3)), "R": np.ones((300, 3, 3))}
    path = written(tmp_path, ".npz", {"t": T, "p": X[0, :, 0], "deep": np.ones((2,) * 4), **others})
    assert open_table(path).names == ("t", "p")
    left_out = [n.subjects for n in describe_log(path).notes if n.code == "channels.left-out"]
    assert {*others, "deep"} <= {name for names in left_out for name in names}
