"""Arrays with separate clocks, assigned by their place in a file."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from heli_jax import cli, load_config
from heli_jax.config import read_flights
from heli_jax.flights import describe_log
from heli_jax.flights.formats.arrays import by_clocks
from heli_jax.flights.formats.library_arrays import open_hdf5, open_mat

FAST, SLOW = 5.0 + 0.01 * np.arange(1000), 5.0 + 0.02 * np.arange(500)
STICK = np.where(SLOW < 6, 0.0, 0.4 * np.sign(np.sin(2.1 * SLOW)))
RATE = np.interp(FAST, SLOW, np.convolve(STICK, 0.2 * np.exp(-(SLOW - 5.0) / 0.2))[: SLOW.size])


def test_new_takes_the_clock_of_each_group(tmp_path: Path) -> None:
    path, out = tmp_path / "run.mat", tmp_path / "run.yaml"
    imu = {"time_ms": 1e3 * FAST, "gyro": np.column_stack([RATE, 0 * RATE, 0 * RATE])}
    log = {"imu": imu, "rc": {"t": SLOW, "aileron": STICK}, "temperature": np.arange(77.0)}
    scipy.io.savemat(path, {"log": log})
    assert cli.main(["new", str(path), "--out", str(out), "--model", "linear:roll"]) == 0
    assert [n.value for n in describe_log(path).notes if n.code == "clock.of-arrays"] == [2]
    assert "time:" not in out.read_text()
    text = out.read_text().replace("rate: 50 ", "rate: 100")
    out.write_text(text)
    (flight,) = read_flights(load_config(out))
    at = flight.t0 + flight.dt * np.arange(flight.n_samples)
    np.testing.assert_allclose(flight.outputs["p"], np.interp(at, FAST, RATE), atol=1e-6)


@pytest.mark.parametrize(
    ("names", "of"),
    [
        # By the group, and by the nearest group above.
        (("imu.t", "rc.t", "imu.x", "rc.x"), {"imu.x": "imu.t", "rc.x": "rc.t"}),
        (("time", "rc.t", "imu.x", "rc.x"), {"imu.x": "time", "rc.x": "rc.t"}),
    ],
)
def test_clocks_of_one_length_are_told_apart(tmp_path: Path, names, of) -> None:
    """Test two clocks of equal length: only their place assigns them to arrays."""
    content: dict = {}
    for i, name in enumerate(names):
        *group, leaf = name.split(".")
        level = content
        for part in group:
            level = level.setdefault(part, {})
        level[leaf] = (1 + i) * SLOW if i < 2 else np.cos(SLOW + i)
    scipy.io.savemat(tmp_path / "a.mat", content)
    log = by_clocks(open_mat(tmp_path / "a.mat"))
    assert log is not None
    for name, clock in of.items():
        assert log.topic_of(name).clock == clock
        np.testing.assert_allclose(log.channel(name).times, (1 + names.index(clock)) * SLOW)


def test_one_clock_is_none_of_several(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"t": SLOW, "u": STICK, "p": STICK})
    assert by_clocks(open_mat(tmp_path / "a.mat")) is None


def test_groups_of_hdf5(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["imu/timestamp"], file["imu/p"] = 1e6 * FAST, RATE
        file["imu/timestamp"].attrs["units"] = "us"
        file["rc/timestamp"], file["rc/ail"] = SLOW, STICK
    log = by_clocks(open_hdf5(tmp_path / "a.h5"))
    assert log is not None
    np.testing.assert_allclose(log.channel("imu/p").times, FAST)
    np.testing.assert_array_equal(log.channel("rc/ail").values, STICK)
