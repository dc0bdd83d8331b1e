"""The store on disk: labels, chunks, resuming, and refusals."""

import errno
import json
import shutil

import jax
import numpy as np
import pytest
import xarray as xr

from heli_jax import Flight, models, sweep
from heli_jax.errors import InputError
from heli_jax.sweeps import Range, Reduce, paired, sobol
from heli_jax.sweeps import store as stores
from heli_jax.sweeps.batching import split_for
from heli_jax.sweeps.spec import job
from heli_jax.sweeps.summary import summary
from heli_jax.sweeps.worker import Worker

ROLL = models.roll_on_stand
DESIGN = sobol({"Ixx": Range(0.02, 0.05, "log"), "a": Range(4.0, 6.0)}, 300, seed=2)
REDUCE = {"rms": Reduce("rms", "roll"), "fit": Reduce("fit", "roll"), "mode": Reduce("modes")}


@pytest.fixture(scope="module")
def short(record):
    return Flight(
        dt=0.02,
        inputs={"x_roll": record.inputs["x_roll"][:50]},
        outputs={"roll": record.outputs["roll"][:50]},
        name="short",
    )


@pytest.fixture(scope="module")
def run(bench30, short):
    def run(out=None, design=DESIGN, reduce=REDUCE, **options):
        options = {"chunk": 32, "lanes": 16} | options
        return sweep(ROLL, bench30, short, design, reduce, out=out, **options)

    return run


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """Return a finished sweep on disk."""
    out = tmp_path_factory.mktemp("sweeps") / "whole"
    run(out)
    return out


def equal(a, b):
    return set(a.variables) == set(b.variables) and all(
        a[n].values.tobytes() == b[n].values.tobytes() for n in a.variables
    )


def test_xarray_reads_the_store_by_itself(whole):
    found = xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None)
    assert set(found.coords) == {"Ixx", "a", "status"}
    assert found["rms"].dims == ("element",)
    assert found["mode_real"].dims == ("element", "mode")
    assert found["rms"].attrs["units"] == "rad"
    assert found["Ixx"].attrs["units"] == "kg m^2"
    assert found.attrs["split"] == {"chunk": 32, "lanes": 16, "backend": "fused"}
    assert found.attrs["axes"] == ["Ixx", "a"]
    assert json.loads(found.attrs["description"])["design"]["n"] == 300
    np.testing.assert_array_equal(found["a"], DESIGN.values(0, 300)["a"])
    assert not found["status"].any()
    # An interrupt uses this number to state if anything is stored.
    assert len(list(whole.glob("sweep.zarr/status/c/*"))) == 10
    assert np.isfinite(found["rms"]).all()


def test_the_summary_counts_and_names_the_worst(whole):
    found = json.loads((whole / "summary.json").read_text())
    data = xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None)
    assert found["elements"] == 300
    assert found["status"] == {"ok": 300, "diverged": 0, "out_of_range": 0, "not_run": 0}
    assert found["results"]["rms"]["median"] == pytest.approx(float(np.median(data["rms"])))
    assert found["worst"]["rms"][0]["element"] == int(np.argmax(data["rms"].values))
    assert found["worst"]["fit"][0]["element"] == int(np.argmin(data["fit"].values))
    assert found["best"]["rms"][0]["element"] == int(np.argmin(data["rms"].values))
    assert found["best"]["fit"][0]["element"] == int(np.argmax(data["fit"].values))
    assert found["timing"]["computed_chunks"] == found["timing"]["chunks"] == 10


def test_the_summary_is_that_of_all_elements(bench30, short, whole):
    data = xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None).load()
    data["status"][[3, 150, 299]] = [1, 2, 1]
    data["rms"][7] = np.inf
    data["fit"].values[[20, 200, 100]] = -1e9
    data.attrs |= {"versions": {}, "seed": 0}
    of = job(ROLL, bench30, short, DESIGN, REDUCE)
    at_once = summary(data, of, {})
    used = (data["status"] == 0) & np.isfinite(data["rms"])
    found, wanted = at_once["results"]["rms"], data["rms"].values[used]
    q = [found[n] for n in ("min", "q05", "median", "q95", "max")]
    np.testing.assert_allclose(q, np.quantile(wanted, [0.0, 0.05, 0.5, 0.95, 1.0]), rtol=1e-14)
    assert found["n"] == 296
    assert at_once["results"]["mode_real"]["n"] == 297 * data.sizes["mode"]
    assert at_once["axes"]["a"]["min"] == data["a"].values.min()
    assert [row["element"] for row in at_once["worst"]["fit"]][:3] == [20, 100, 200]
    order = np.argsort(-np.where(used, data["rms"], -np.inf))[:5]
    assert [row["element"] for row in at_once["worst"]["rms"]] == order.tolist()
    assert at_once["worst"]["rms"][1]["value"] == data["rms"].values[order[1]]
    assert at_once["worst"]["rms"][1]["axes"]["a"] == data["a"].values[order[1]]


@pytest.mark.parametrize("options", [{}, {"chunk": 100}, {"chunk": 300}])
def test_chunks_and_devices_change_no_bit(run, whole, options):
    on_disk = xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None)
    assert equal(run(None, **options), on_disk)


@pytest.mark.slow
def test_several_devices_change_no_bit(tmp_path):
    """Test in a separate process, since JAX fixes the number of devices at its start."""
    import subprocess
    import sys

    program = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 3)
import numpy as np
from heli_jax import Flight, load_vehicle, models, sweep
from heli_jax.sweeps import Range, Reduce, sobol
stick = np.repeat(np.random.default_rng(0).uniform(-3e-6, 3e-6, 20), 10)
flight = Flight(dt=0.02, inputs={"x_roll": stick}, outputs={})
design = sobol({"Ixx": Range(0.02, 0.05)}, 200)
found = [
    sweep(models.roll, load_vehicle(sys.argv[1]), flight, design, {"rms": Reduce("rms", "roll")},
          lanes=16, chunk=96, devices=jax.local_devices()[:k])["rms"].values.tobytes()
    for k in (1, 2, 3)
]
assert found[0] == found[1] == found[2]
"""
    from pathlib import Path

    vehicle = Path(__file__).parents[2] / "configs" / "vehicles" / "bench-30.yaml"
    subprocess.run([sys.executable, "-c", program, str(vehicle)], check=True, cwd=tmp_path)


def test_what_is_finished_is_not_computed_again(run, whole, tmp_path, monkeypatch):
    out = tmp_path / "cut"
    computed = []
    finish = Worker.finish

    def counted(self, pending):
        if len(computed) == 4:
            raise KeyboardInterrupt
        computed.append(pending.start)
        return finish(self, pending)

    monkeypatch.setattr(Worker, "finish", counted)
    with pytest.raises(KeyboardInterrupt):
        run(out)
    monkeypatch.setattr(Worker, "finish", finish)
    part = xr.open_zarr(out / "sweep.zarr", consolidated=False, chunks=None)
    assert np.count_nonzero(part["status"] == 0) == 4 * 32
    assert np.count_nonzero(part["status"] == 255) == 300 - 4 * 32
    seen = []
    monkeypatch.setattr(Worker, "finish", lambda self, p: seen.append(p.start) or finish(self, p))
    found = run(out, resume=True, chunk=None, lanes=None)
    assert seen == list(range(4 * 32, 300, 32))
    assert equal(found, xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None))
    seen.clear()
    run(out, resume=True)
    assert seen == []


def test_a_chunk_without_status_is_computed_again(run, whole, tmp_path):
    """Test a kill between results and status of a chunk."""
    out = tmp_path / "torn"
    shutil.copytree(whole, out)
    (out / "sweep.zarr" / "status" / "c" / "3").unlink()
    (out / "sweep.zarr" / "fit" / "c" / "3").write_bytes(b"")
    (out / "sweep.zarr" / "rms" / "c" / "3").unlink()
    found = run(out, resume=True)
    assert equal(found, xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"design": sobol({"Ixx": Range(0.02, 0.05, "log")}, 300)}, "design"),
        ({"design": sobol({"Ixx": Range(0.02, 0.05, "log"), "a": Range(4.0, 6.0)}, 301, 2)},
         "design.n was 300 and is 301"),
        ({"reduce": {"rms": Reduce("rms", "roll")}}, "reduce.fit"),
        ({"solver": "rk4"}, "solver was exact and is rk4"),
        ({"precision": "float32"}, "precision was float64 and is float32"),
        ({"chunk": 64}, "chunk 32, expected the same, got 64"),
        ({"lanes": 64}, "lanes 16, expected the same, got 64"),
        ({"backend": "xla"}, "backend fused"),
    ],
)  # fmt: skip
def test_the_store_of_another_sweep_is_refused(run, whole, changed, words):
    before = {p: p.stat().st_mtime_ns for p in (whole / "sweep.zarr").rglob("*")}
    with pytest.raises(InputError, match=words):
        run(whole, resume=True, **changed)
    assert before == {p: p.stat().st_mtime_ns for p in (whole / "sweep.zarr").rglob("*")}


def test_the_store_of_another_vehicle_or_flight_is_refused(bench30, short, whole):
    from heli_jax.naming import replace

    heavier = replace(bench30, Ixx_added=bench30.Ixx_added + 0.01)
    with pytest.raises(InputError, match=r"vehicle.Ixx_added was 0.0 and is 0.01"):
        sweep(ROLL, heavier, short, DESIGN, REDUCE, out=whole, resume=True)
    moved = Flight(dt=0.02, inputs={"x_roll": short.inputs["x_roll"] + 1e-9},
                   outputs=short.outputs, name="short")  # fmt: skip
    with pytest.raises(InputError, match="flights was"):
        sweep(ROLL, bench30, moved, DESIGN, REDUCE, out=whole, resume=True)


def test_a_directory_that_exists_is_kept(run, whole, tmp_path):
    with pytest.raises(InputError, match="exists already"):
        run(whole)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter").write_text("dear")
    with pytest.raises(InputError, match="is not a store of a sweep"):
        run(tmp_path / "mine", resume=True)
    assert (tmp_path / "mine" / "letter").read_text() == "dear"
    with pytest.raises(InputError, match="exists already"):
        run(tmp_path / "mine" / "letter")


def test_two_writers_are_refused(run, whole):
    with (
        stores.only_writer(whole, "--out x"),
        pytest.raises(InputError, match="another process is writing"),
    ):
        run(whole, resume=True)
    run(whole, resume=True)


def test_a_full_disk_ends_in_words_and_keeps_what_is_done(run, whole, tmp_path, monkeypatch):
    out, written = tmp_path / "full", []
    import zarr.storage._local as local

    put = local._put

    def full(path, value, exclusive=False):
        if "status/c/" in str(path):
            written.append(path)
        if len(written) > 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        return put(path, value, exclusive)

    monkeypatch.setattr(local, "_put", full)
    with pytest.raises(InputError, match=r"full: cannot be written \(No space left on device\)"):
        run(out)
    monkeypatch.setattr(local, "_put", put)
    part = xr.open_zarr(out / "sweep.zarr", consolidated=False, chunks=None)
    assert np.count_nonzero(part["status"] == 0) == 3 * 32
    found = run(out, resume=True)
    assert equal(found, xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None))


def test_a_store_that_lacks_something_is_refused(run, whole, tmp_path):
    gone = tmp_path / "gone"
    shutil.copytree(whole, gone)
    (gone / "sweep.zarr" / "fit" / "c" / "5").unlink()
    with pytest.raises(InputError, match="gone: fit has 9 of 10 finished chunks"):
        run(gone, resume=True)


def test_damaged_chunks_are_computed_again(run, whole, tmp_path, monkeypatch):
    out = tmp_path / "damaged"
    shutil.copytree(whole, out)
    for name, chunk in (("rms", 3), ("fit", 5), ("Ixx", 7)):
        path = out / "sweep.zarr" / name / "c" / str(chunk)
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(bytes(data) if chunk > 3 else bytes(data)[:7])
    seen, finish = [], Worker.finish
    monkeypatch.setattr(Worker, "finish", lambda self, p: seen.append(p.start) or finish(self, p))
    found = run(out, resume=True)
    assert seen == [3 * 32, 5 * 32, 7 * 32]
    assert equal(found, xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None))


def test_an_empty_folder_may_be_gone_on_with(run, whole, tmp_path):
    out = tmp_path / "made"
    out.mkdir()
    with pytest.raises(InputError, match="exists already"):
        run(out)
    found = run(out, resume=True)
    assert equal(found, xr.open_zarr(whole / "sweep.zarr", consolidated=False, chunks=None))


def test_more_lanes_than_elements_are_as_many(run, tmp_path):
    found = run(tmp_path / "out", lanes=10**6)
    assert found.attrs["split"]["lanes"] == 300
    run(tmp_path / "out", lanes=10**6, resume=True)


def test_a_store_that_is_no_store_is_refused(run, whole, tmp_path):
    out = tmp_path / "broken"
    shutil.copytree(whole, out)
    (out / "sweep.zarr" / "zarr.json").write_text("{")
    with pytest.raises(InputError, match="is not a store of a sweep"):
        run(out, resume=True)


def test_a_result_that_is_nowhere_a_number_is_finished_too(run, tmp_path):
    out = tmp_path / "nan"
    design = paired({"Ixx": np.full(64, np.nan)})
    run(out, design=design, reduce={"rms": Reduce("rms", "roll")})
    found = xr.open_zarr(out / "sweep.zarr", consolidated=False, chunks=None)
    assert (found["status"] == 1).all()
    assert json.loads((out / "summary.json").read_text())["results"]["rms"] == {
        "unit": "rad",
        "n": 0,
    }


def test_how_a_sweep_is_cut(bench30, record):
    def cut(n, **asked):
        design = sobol({"Ixx": Range(0.02, 0.05)}, n)
        wanted = job(ROLL, bench30, record, design, {"rms": Reduce("rms", "roll")})
        return split_for(wanted, devices=jax.local_devices()[:1], **{"backend": "xla", **asked})

    assert cut(10).lanes == 8
    assert cut(10).chunk == 16
    assert cut(100_000) == cut(100_000)
    assert cut(100_000).lanes == 64
    assert cut(1_000_000).chunk <= 1 << 16
    assert cut(1000, chunk=77, lanes=5) == (77, 5, "xla")
    assert cut(1000, chunk=10**18, lanes=5) == (1000, 5, "xla")
    assert cut(1000, chunk=77, lanes=5, backend="auto") == (77, 5, "fused")
