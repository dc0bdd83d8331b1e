"""Packed numbers of NetCDF and HDF5, against xarray and the text of the conventions."""

from pathlib import Path

import numpy as np
import pytest
import xarray

from heli_jax import cli
from heli_jax.flights import Signal, describe_log, read_flight
from heli_jax.flights.formats.arrays import Packing, unpack
from heli_jax.flights.open_log import open_log

N = 50
T = 0.02 * np.arange(N)
ROLL = np.round(100.0 * (np.degrees(0.3 * np.sin(T)) - 5.0)).astype(np.int16)
RATE = np.round(1000.0 * np.cos(T)).astype(np.int32)
RATE[[3, 7]] = -999999
COUNT = np.arange(200, 200 + N).astype(np.uint8).view(np.int8)
SPEED = np.float32(T)
SPEED[4] = np.float32(-9999.9)
PACKED = {
    "time": (T, {"units": "s"}),
    "aileron": (np.sin(T), {"units": "1"}),
    "roll": (ROLL, {"units": "degrees", "scale_factor": 0.01, "add_offset": 5.0}),
    "p": (RATE, {"units": "rad/s", "scale_factor": 0.001, "_FillValue": np.int32(-999999)}),
    "count": (COUNT, {"_Unsigned": "true", "_FillValue": np.int8(-56)}),
    "speed": (SPEED, {"units": "m/s", "missing_value": np.float32(-9999.9)}),
}


def written(path: Path, sets=PACKED) -> Path:
    """Write stored numbers and attributes unchanged, in NetCDF 3 or HDF5."""
    if path.name.endswith("3.nc"):
        raw = {n: ("time", x, attributes) for n, (x, attributes) in sets.items()}
        xarray.Dataset(raw).to_netcdf(path, engine="scipy")
        return path
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(path, "w") as file:
        for name, (values, attributes) in sets.items():
            file[name] = values
            file[name].attrs.update(attributes)
    return path


@pytest.mark.parametrize("name", ["flight3.nc", "flight4.nc"])
def test_all_files_are_unpacked_as_xarray_does(tmp_path, name):
    path = written(tmp_path / name)
    raw = {n: ("time", x, dict(attributes)) for n, (x, attributes) in PACKED.items()}
    wanted = xarray.decode_cf(xarray.Dataset(raw), decode_times=False)
    table = open_log(path)
    for name in PACKED:
        np.testing.assert_allclose(table.numbers([name])[name], wanted[name].values, rtol=1e-14)
    info = describe_log(path)
    units = {c.name: c.unit for c in info.columns}
    assert (units["roll"], units["p"]) == ("degrees", "rad/s")
    said = {n.code: n for n in info.notes}
    assert "p" in said["samples.marks"].subjects
    # In radians for a fit; and as guessed by `new` and written by `convert`.
    signals = {"inputs": {}, "outputs": {"phi": Signal("roll", "deg", "rad")}}
    flight = read_flight(path, time="time", **signals)
    np.testing.assert_allclose(flight.outputs["phi"], 0.3 * np.sin(T), atol=1e-4)
    out = tmp_path / "out.csv"
    assert cli.main(["convert", str(path), str(out), "--signals", "roll"]) == 0
    made = open_log(out).numbers(["roll"])["roll"]
    np.testing.assert_allclose(made, np.degrees(0.3 * np.sin(T)), atol=0.006)


def test_marks_of_all_kinds_and_unsigned_numbers():
    several, _ = unpack(np.int16([1, -1, -9, 4]), {"missing_value": np.int16([-1, -9])})
    np.testing.assert_array_equal(several, [1, np.nan, np.nan, 4])
    # A mark outside the type's range never occurs; NaN needs no mark.
    assert unpack(np.int8([0, 1]), {"_FillValue": np.nan, "missing_value": 300.5})[1] == 0
    assert unpack(np.float64([0, np.nan]), {"_FillValue": np.nan})[1] == 0
    assert unpack(np.int16([0, 1]), {"missing_value": "none"})[1] == 0
    found, _ = unpack(np.int8([0, 1, -2, -1]), {"_Unsigned": "true"})
    np.testing.assert_array_equal(found, [0, 1, 254, 255])


def test_a_scale_that_is_none_leaves_its_data_set_out(tmp_path):
    for scale in ("a tenth", 0.0, np.nan, [0.1, 0.2]):
        with pytest.raises(Packing):
            unpack(ROLL, {"scale_factor": scale})
    sets = PACKED | {"roll": (ROLL, {"scale_factor": 0.0})}
    table = open_log(written(tmp_path / "flight3.nc", sets))
    assert "roll" not in table.names
    assert [n.subjects for n in table.notes if n.code == "channels.left-out"] == [("roll",)]


def test_the_attribute_of_a_unit(tmp_path):
    clock = (np.arange(N) * 20_000, {"Units": np.bytes_("us")})
    name = np.bytes_("This is a netCDF dimension but not a netCDF variable.        50")
    # Also a dimension of NetCDF 4 without values, which is not a channel.
    sets = {"clock": clock, "phi": (T, {"unit": "deg"}), "x": (np.zeros(N), {"NAME": name})}
    info = describe_log(written(tmp_path / "flight.h5", sets))
    assert info.time is not None
    assert (info.time.column, info.time.guessed, len(info.columns)) == ("clock", False, 2)
    assert (info.time.rate, info.columns[1].unit) == (pytest.approx(50.0), "deg")


def test_tables_of_named_fields_in_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    kind = [("t", "f8"), ("phi", "f4"), ("gyro", "f8", (3,)), ("mode", "S4")]
    rows = np.zeros(N, kind)
    rows["t"], rows["phi"], rows["gyro"] = T, np.sin(T), np.c_[T, T**2, T**3]
    path = tmp_path / "flight.h5"
    with h5py.File(path, "w") as file:
        file["run/log"] = rows
        file["run/log"].attrs["units"] = ["s", "deg", "rad/s", ""]
        file["run/log"].attrs["scale_factor"] = 7.0  # of an unknown field
    table = open_log(path)
    assert table.names == ("run/log/t", "run/log/phi", *(f"run/log/gyro[{i}]" for i in range(3)))
    assert table.units["run/log/gyro[1]"] == "rad/s"
    np.testing.assert_array_equal(table.numbers(["run/log/gyro[2]"])["run/log/gyro[2]"], T**3)
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.column, info.time.rate) == ("run/log/t", pytest.approx(50.0))
