"""Damaged logs of every format end in a flight or in one sentence.

`experiments/fuzz_logs.py` has more attempts.
"""

import runpy
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet
import pytest
import scipy.io
import xarray

from . import log_writers as writers
from .test_autopilot_logs import MESSAGES, ROWS, SETTINGS, TOPICS
from .test_blackbox import some_flight

FUZZ = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "fuzz_logs.py"))
damaged, outcome = FUZZ["damaged"], FUZZ["outcome"]
T, X = np.arange(60) / 50, np.sin(np.arange(60) / 3)
COUNT, COUNT_APART = 20, 4
"""Seconds for formats that are read in a separate process."""


def text(path):
    messages = {"ATT": (210, "Qcf", "TimeUS,Roll,Err")}
    rows = [("ATT", (1_000_000 + 40_000 * i, -0.5 * i, 0.25)) for i in range(60)]
    path.write_bytes(writers.dataflash_text(messages, rows))


def csv(path):
    path.write_text(
        "t,x\n" + "\n".join(f"{t:.2f},{x!r}" for t, x in zip(T, X.tolist(), strict=True))
    )


FORMATS = {
    "flight.ulg": lambda path: path.write_bytes(writers.ulog(TOPICS, dropouts=[3], **SETTINGS)),
    "flight.bin": lambda path: path.write_bytes(writers.dataflash(MESSAGES, ROWS)),
    "flight.log": text,
    "flight.bbl": lambda path: path.write_bytes(some_flight(slow=[(3, 1)]) + some_flight()),
    "flight.csv": csv,
    "flight.dat": csv,
    "flight.parquet": lambda path: pyarrow.parquet.write_table(pa.table({"t": T, "x": X}), path),
    "flight.feather": lambda path: pyarrow.feather.write_feather(pa.table({"t": T, "x": X}), path),
    "flight.npz": lambda path: np.savez_compressed(path, t=T, x=X),
    "flight.npy": lambda path: np.save(path, np.rec.fromarrays([T, X], names="t,x")),
    "flight.mat": lambda path: scipy.io.savemat(path, {"log": {"t": T, "x": X}}),
    "flight.nc": lambda path: xarray.Dataset({"t": ("n", T), "x": ("n", X)}).to_netcdf(
        path, engine="scipy"
    ),
}


@pytest.mark.parametrize("name", FORMATS)
def test_damage_ends_in_a_flight_or_a_sentence(tmp_path, name):
    path = tmp_path / name
    FORMATS[name](path)
    assert outcome(path) in ("flight", "noted")
    ends = set()
    count = COUNT_APART if path.suffix in (".mat", ".nc", ".ulg") else COUNT
    for words, data in damaged(path.read_bytes(), count):
        path.write_bytes(data)
        try:
            ends.add(outcome(path))
        except (Exception, FUZZ["Hung"]) as e:
            raise AssertionError(f"{name}, {words}: {type(e).__name__} {e}") from e
    assert "refused" in ends
