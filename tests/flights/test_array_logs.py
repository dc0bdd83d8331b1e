"""MATLAB, NetCDF, HDF5 and blank-separated columns, against SciPy and xarray."""

import io
import struct
import sys

import h5py
import numpy as np
import pytest
import scipy.io
import xarray

from heli_jax.errors import InputError
from heli_jax.flights import Signal, describe_log, read_flight
from heli_jax.flights.formats import apart
from heli_jax.flights.open_log import open_log, open_table

N = 50
T = 3.0 + 0.02 * np.arange(N)
ROLL = np.sin(T)
SIGNALS = {
    "inputs": {"stick": Signal("log.stick.data", "1", "1")},
    "outputs": {"roll": Signal("log.roll.data", "deg", "rad")},
}


def mat_of(path, **changes):
    log = {"time": T[:, None], "roll": {"data": ROLL, "unit": "deg"}, "stick": {"data": T**2}}
    scipy.io.savemat(path, {"log": log | changes})
    return path


def test_structures_of_matlab(tmp_path):
    path = mat_of(tmp_path / "flight.mat", matrix=np.arange(3.0 * N).reshape(N, 3))
    flight = read_flight(path, time="log.time", **SIGNALS)
    assert (flight.dt, flight.t0) == (pytest.approx(0.02), 3.0)
    np.testing.assert_allclose(flight.outputs["roll"], np.deg2rad(ROLL), rtol=1e-15)
    np.testing.assert_array_equal(flight.inputs["stick"], T**2)
    # A matrix consists of its columns.
    table = open_log(path)
    column = table.numbers(["log.matrix[1]"])["log.matrix[1]"]
    np.testing.assert_array_equal(column, 3.0 * np.arange(N) + 1)
    info = describe_log(path)
    assert info.time is not None
    assert (info.format, info.time.column, info.time.rate) == ("mat", "log.time", pytest.approx(50))


def test_arrays_of_different_lengths(tmp_path):
    path = mat_of(tmp_path / "flight.mat", roll={"data": ROLL[:-1]})
    with pytest.raises(InputError):
        read_flight(path, time="log.time", **SIGNALS)


def test_netcdf(tmp_path):
    path = tmp_path / "flight.nc"
    times = ("time", T, {"units": "seconds since 2024-01-01"})
    xarray.Dataset({"roll": ("time", ROLL)}, coords={"time": times}).to_netcdf(path, engine="scipy")
    flight = read_flight(path, time="time", inputs={}, outputs={"roll": Signal("roll", "1", "1")})
    np.testing.assert_array_equal(flight.outputs["roll"], ROLL)
    assert flight.t0 == 3.0


def test_version_7_3_needs_h5py_and_says_so(tmp_path, monkeypatch):
    path = tmp_path / "flight.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError):
        open_log(path)


def external(file, secret):
    file.create_dataset("x", (8,), "f8", external=[(str(secret), 0, 64)])


def virtual(file, secret):
    with h5py.File(secret.with_name("other.h5"), "w") as other:
        other["y"] = np.arange(8.0)
    layout = h5py.VirtualLayout((8,), "f8")
    layout[:] = h5py.VirtualSource(secret.with_name("other.h5"), "y", (8,))
    file.create_virtual_dataset("x", layout)


def linked(file, secret):
    file["x"] = h5py.ExternalLink(str(secret.with_name("other.h5")), "/y")


@pytest.mark.parametrize(
    ("name", "add"),
    [
        ("flight.nc", external),
        ("flight.h5", virtual),
        ("flight.h5", linked),
    ],
)
def test_a_log_reads_no_other_file(tmp_path, name, add):
    secret = tmp_path / "secret"
    secret.write_bytes(b"password" * 8)
    with h5py.File(tmp_path / name, "w") as file:
        file["t"] = T
        add(file, secret)
    with pytest.raises(InputError):
        open_log(tmp_path / name)


def test_a_file_over_which_its_reader_dies_or_loops_is_no_log(tmp_path, monkeypatch):
    path = tmp_path / "flight.h5"
    with h5py.File(path, "w") as file:
        file["t"] = T
    assert open_log(path).names == ("t",)
    # libhdf5's behaviour with damaged files, in the reading process.
    for fault in ("import os; os.abort()", "while True: pass"):
        (tmp_path / "h5py").mkdir(exist_ok=True)
        (tmp_path / "h5py" / "__init__.py").write_text(fault)
        monkeypatch.setattr(apart, "_SECONDS", 1)
        monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
        with pytest.raises(InputError):
            open_log(path)


@pytest.mark.parametrize("options", [{"do_compression": True}, {}])
def test_what_scipy_writes_is_read(tmp_path, options):
    content = {"t": T, "x": np.float32(ROLL), "m": np.arange(2.0 * N).reshape(N, 2), "w": "text"}
    cell = np.empty(2, object)
    cell[0], cell[1] = T, np.arange(N, dtype=np.int16)
    runs = np.array([(T,), (ROLL,)], [("phi", object)])
    content |= {"cell": cell, "runs": runs, "e": np.zeros((0, 0)), "deep": {"a": {"b": T}}}
    path = tmp_path / "flight.mat"
    scipy.io.savemat(path, content, **options)
    table = open_log(path)
    wanted = {"t": T, "x": np.float32(ROLL), "m[1]": content["m"][:, 1]}
    wanted |= {"cell[0]": T, "cell[1]": np.arange(N), "runs[1].phi": ROLL, "deep.a.b": T}
    for name, values in wanted.items():
        np.testing.assert_array_equal(table.numbers([name])[name], values)
    assert set(table.names) == wanted.keys() | {"m[0]", "runs[0].phi"}


def test_a_matlab_file_that_claims_much(tmp_path):
    file = io.BytesIO()
    scipy.io.savemat(file, {"x": np.zeros((4, 4))})
    data = bytearray(file.getvalue())
    at = data.index((4).to_bytes(4, "little") * 2)
    data[at : at + 8] = (2**30).to_bytes(4, "little") * 2
    path = tmp_path / "claim.mat"
    path.write_bytes(bytes(data))
    with pytest.raises(InputError):
        open_log(path)


def an_object(name: str, kind: str) -> bytes:
    """Return a MATLAB variable of an opaque class, which 'MAT-File Format' does not describe."""

    def element(code: int, data: bytes) -> bytes:
        return struct.pack("<2I", code, len(data)) + data + bytes(-len(data) % 8)

    inner = element(6, struct.pack("<2I", 17, 0)) + element(1, name.encode())
    inner += element(1, b"MCOS") + element(1, kind.encode())
    data = element(6, struct.pack("<2I", 13, 0)) + element(5, struct.pack("<2i", 2, 1))
    data += element(1, b"") + element(6, struct.pack("<2I", 0xDD000000, 1))
    return element(14, inner + element(14, data))


@pytest.mark.parametrize(("name", "kind"), [("T", "timetable"), ("x", "my.class")])
def test_objects_of_matlab_are_left_out(tmp_path, name, kind):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"n": 1.0})
    path.write_bytes(path.read_bytes() + an_object(name, kind))
    with pytest.raises(InputError):
        open_table(path)
    scipy.io.savemat(path, {"t": np.arange(9.0), "z": np.arange(9.0) + 2j})
    path.write_bytes(path.read_bytes() + an_object(name, kind))
    table = open_table(path)
    assert table.names == ("t",)
    said = [("channels.left-out", ("z", name))]
    assert [(n.code, n.subjects) for n in table.notes] == said
    np.testing.assert_array_equal(table.numbers(["t"])["t"], np.arange(9.0))


def test_structures_of_matlab_7_3_have_the_paths_of_older_ones(tmp_path):
    t = 0.01 * np.arange(50)
    with h5py.File(tmp_path / "log.mat", "w", userblock_size=512) as file:
        file["out/time"], file["out/roll/data"] = t[None, :], np.cos(t)[None, :]
        letters = file.create_dataset("out/title", data=np.array([[97], [98]], np.uint16))
        letters.attrs["MATLAB_class"] = np.bytes_("char")
        # Elements of a cell stay separate, with names that have no meaning.
        cell = file.create_dataset("C", (1, 1), dtype=h5py.ref_dtype)
        cell[0, 0] = file.create_dataset("#refs#/c", data=t[None, :]).ref
    log = open_table(tmp_path / "log.mat")
    assert set(log.names) == {"out.time", "out.roll.data"}
    np.testing.assert_array_equal(log.numbers(["out.roll.data"])["out.roll.data"], np.cos(t))
