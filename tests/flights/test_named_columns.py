"""Matrices whose columns have names beside them, as other programs keep them."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import xarray

from heli_jax.flights.describe import describe_log
from heli_jax.flights.open_log import open_table

N = 60
T, U = 0.02 * np.arange(N), np.sin(np.arange(N))
P, PHI = np.cos(np.arange(N)), np.arange(N) ** 0.5
TABLE = np.stack([T, U, P, PHI], axis=1)
NAMES = ["t", "u", "p", "phi"]


def cells(*texts: str) -> np.ndarray:
    return np.array(texts, dtype=object)


def saved(path: Path, **arrays) -> Path:
    scipy.io.savemat(path, arrays)
    return path


def check(path: Path, stem: str, names=NAMES) -> None:
    table = open_table(path)
    for name, values in zip(names, TABLE.T[-len(names) :], strict=True):
        np.testing.assert_array_equal(table.numbers([f"{stem}{name}"])[f"{stem}{name}"], values)


@pytest.mark.parametrize("names", [cells(*NAMES), cells(*NAMES)[:, None], np.array(NAMES)])
@pytest.mark.parametrize("turned", [False, True])
def test_cells_and_rows_of_letters(tmp_path: Path, names, turned) -> None:
    check(saved(tmp_path / "a.mat", data=TABLE.T if turned else TABLE, names=names), "data.")


def test_an_exported_iddata_has_its_names_units_and_rate(tmp_path: Path) -> None:
    data = {
        "OutputData": np.stack([P, PHI], axis=1),
        "InputData": U[:, None],
        "OutputName": cells("p", "phi"),
        "OutputUnit": cells("rad/s", "rad"),
        "InputName": cells("u"),
        "InputUnit": cells("deg"),
        "Ts": 0.02,
    }
    path = saved(tmp_path / "a.mat", z=data)
    check(path, "z.OutputData.", ["p", "phi"])
    np.testing.assert_array_equal(open_table(path).numbers(["z.InputData.u"])["z.InputData.u"], U)
    info = describe_log(path)
    assert {c.name: c.unit for c in info.columns if c.unit} == {
        "z.OutputData.p": "rad/s",
        "z.OutputData.phi": "rad",
        "z.InputData.u": "deg",
    }
    assert info.time is not None
    assert info.time.counted == 50


def test_messages_of_a_ground_station_have_their_clocks(tmp_path: Path) -> None:
    lines = np.arange(N) + 7.0
    path = saved(
        tmp_path / "a.mat",
        ATT=np.stack([lines, 1e6 * T, PHI], axis=1),
        ATT_label=cells("LineNo", "TimeUS", "Roll"),
        RATE=np.stack([lines, 1e6 * T, P, U], axis=1),
        RATE_label=cells("LineNo", "TimeUS", "R", "ROut"),
    )
    info = describe_log(path)
    assert info.time is not None
    # And not the numbers of lines, which increase as well.
    assert (info.time.column, info.time.duration) == ("ATT.TimeUS", pytest.approx(T[-1]))
    np.testing.assert_array_equal(open_table(path).numbers(["RATE.ROut"])["RATE.ROut"], U)


def test_texts_that_name_no_columns_are_left_alone(tmp_path: Path) -> None:
    two = np.stack([P, U], axis=1)
    for others in (
        {"events": cells("start", "stop")},  # called nothing of the kind
        {"names": cells("p", "p")},
        {"names": cells("p", "u", "x")},
        {"labels": cells("a", "b"), "columns": cells("c", "d")},
    ):
        assert open_table(saved(tmp_path / "a.mat", y=two, **others)).names == ("y[0]", "y[1]")


def test_hdf5_has_names_in_data_sets(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("df")  # as pandas writes a frame
        group["axis0"] = np.array(NAMES, "S")
        group["axis1"] = np.arange(N)
        group["block0_items"] = np.array(NAMES, "S")
        group["block0_values"] = TABLE
        file.attrs["fs"] = 50.0
    check(path, "df/block0_values.")
    info = describe_log(path)
    assert info.time is not None
    assert info.time.column == "df/block0_values.t"


def test_matlab_7_3_keeps_names_as_references_to_letters(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    with h5py.File(path, "w") as file:
        file["data"] = TABLE.T
        letters = [[ord(c) for c in name] for name in NAMES]
        references = []
        for i, each in enumerate(letters):
            item = file.create_dataset(f"#refs#/{i}", data=np.array(each, np.uint16)[:, None])
            item.attrs["MATLAB_class"] = np.bytes_("char")
            references.append(item.ref)
        names = file.create_dataset("names", data=references, dtype=h5py.ref_dtype)
        names.attrs["MATLAB_class"] = np.bytes_("cell")
    check(path, "data.")
    # Letters are no samples.
    assert all(name.startswith("data.") for name in open_table(path).names)


def test_coordinates_of_netcdf_name_columns(tmp_path: Path) -> None:
    two = (("time", "ch"), TABLE[:, 2:])
    file = xarray.Dataset({"y": two}, coords={"time": T, "ch": ["p", "phi"]})
    file.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    check(tmp_path / "a.nc", "y.", ["p", "phi"])


def test_structures_of_matlab_7_3_have_the_paths_and_labels_of_older_ones(tmp_path: Path) -> None:
    t = 0.01 * np.arange(50)
    arrays = {"aileron": np.sin(t), "p (rad/s)": np.cos(t)}
    with h5py.File(tmp_path / "log.mat", "w", userblock_size=512) as file:
        fields: dict[str, list] = {"values": [], "label": []}
        for i, (label, values) in enumerate(arrays.items()):
            item = file.create_dataset(f"#refs#/b{i}", data=values[None, :])
            letters = np.array([ord(c) for c in label], np.uint16)[:, None]
            text = file.create_dataset(f"#refs#/a{i}", data=letters)
            text.attrs["MATLAB_class"] = np.bytes_("char")
            fields["values"].append(item.ref)
            fields["label"].append(text.ref)
        for field, references in fields.items():
            item = file.create_dataset(f"out/signals/{field}", (2, 1), dtype=h5py.ref_dtype)
            item[:, 0] = references
        file["out/time"] = t[None, :]
        cell = file.create_dataset("C", (2, 1), dtype=h5py.ref_dtype)
        cell.attrs["MATLAB_class"] = np.bytes_("cell")
        for i in range(2):
            cell[i, 0] = file.create_dataset(f"#refs#/c{i}", data=i + t[None, :]).ref
    log = open_table(tmp_path / "log.mat")
    names = {"out.signals.aileron", "out.signals.p (rad/s)", "out.time", "C[0]", "C[1]"}
    assert set(log.names) == names
    got = log.numbers(["out.signals.p (rad/s)", "C[1]"])
    np.testing.assert_array_equal(got["out.signals.p (rad/s)"], np.cos(t))
    np.testing.assert_array_equal(got["C[1]"], 1 + t)
