"""heli-jax sweep: from a configuration to a directory, and refusals."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xarray as xr
import yaml

from heli_jax import cli

ROOT = Path(__file__).parents[2]


def content(**sweep):
    return {
        "model": "roll-on-stand",
        "vehicle": str(ROOT / "configs" / "vehicles" / "bench-30.yaml"),
        "simulate": {
            "duration": 1.0,
            "rate": 50,
            "inputs": {"x_roll": {"amplitude": 3.0, "unit": "um"}},
        },
        "sweep": {
            "design": "grid",
            "axes": {"Ixx": {"lower": 0.02, "upper": 0.05, "n": 6}},
            "reduce": {"rms": {"signal": "roll", "how": "rms"}},
        }
        | sweep,
    }


@pytest.fixture
def write(tmp_path):
    def write(config, name="study.yaml"):
        path = tmp_path / name
        path.write_text(yaml.safe_dump(config, sort_keys=False))
        return path

    return write


def opened(out):
    return xr.open_zarr(out / "sweep.zarr", consolidated=False, chunks=None)


def test_a_directory_with_all_that_is_promised(write, tmp_path, capsys):
    out = tmp_path / "runs" / "one"
    assert cli.main(["sweep", str(write(content())), "--out", str(out)]) == 0
    assert {p.name for p in out.iterdir()} >= {"config.yaml", "sweep.zarr", "summary.json"}
    assert (out / "figures" / "slices-rms.png").stat().st_size > 1000
    assert json.loads((out / "summary.json").read_text())["status"]["ok"] == 6
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(list((out / "figures").glob("*.png")))
    assert "://" not in page  # only the page itself
    found = opened(out)
    np.testing.assert_allclose(found["Ixx"], np.linspace(0.02, 0.05, 6))
    assert yaml.safe_load(found.attrs["configuration"])["sweep"]["design"] == "grid"
    assert found.attrs["seed"] == 0
    # The resolved configuration makes the same sweep from any folder.
    again = tmp_path / "again"
    assert cli.main(["sweep", str(out / "config.yaml"), "--out", str(again)]) == 0
    assert found["rms"].values.tobytes() == opened(again)["rms"].values.tobytes()
    # It also resumes as the same sweep.
    assert cli.main(["sweep", str(out / "config.yaml"), "--out", str(out), "--resume"]) == 0


@pytest.mark.slow
def test_designs_of_a_configuration(write, tmp_path, capsys):
    table = {"inertia": [0.02, 0.03, np.nan], "lift": [5.0, 5.5, 6.0]}
    pq.write_table(pa.table(table), tmp_path / "some.parquet")
    inner = {
        "design": "zip",
        "of": [
            {"design": "table", "file": "some.parquet",
             "axes": {"Ixx": {"column": "inertia"}, "a": {"column": "lift", "unit": "1/rad"}}},
            {"design": "lhs", "n": 3, "axes": {"If": {"lower": 2e-4, "upper": 4e-4}}},
        ],
    }  # fmt: skip
    angles = {"design": "list", "axes": {"initial.phi": {"values": [0, 10], "unit": "deg"}}}
    config = content(design="product", of=[inner, angles], axes={})
    del config["sweep"]["axes"]
    out = tmp_path / "out"
    assert cli.main(["sweep", str(write(config)), "--out", str(out)]) == 0
    found = opened(out)
    np.testing.assert_array_equal(found["Ixx"], np.repeat(table["inertia"], 2))
    np.testing.assert_array_equal(found["a"], np.repeat(table["lift"], 2))
    np.testing.assert_allclose(found["initial.phi"], np.tile([0.0, np.deg2rad(10)], 3))
    assert found["status"].values.tolist() == [0, 0, 0, 0, 1, 1]


def test_the_python_of_the_documentation_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    page = (ROOT / "docs" / "sweeps.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names = {}
    for block in blocks:
        exec(block.replace('"DIR', f'"{tmp_path}/out'), names)
    assert len(blocks) == 2
    assert names["ds"].sizes["element"] == 128
    assert not names["ds"]["status"].any()


WRONG = {
    "no sweep": lambda c: c.pop("sweep"),
    "no inputs": lambda c: c.pop("simulate"),
    "no flights": lambda c: c["sweep"].update(inputs="flights"),
    "no axes": lambda c: c["sweep"].update(axes={}),
    "empty axis": lambda c: c["sweep"].update(axes={"Ixx": {"values": []}}),
    "unknown axis": lambda c: c["sweep"].update(axes={"ixx": {"values": [1]}}),
    "unknown state": lambda c: c["sweep"].update(axes={"initial.fi": {"values": [1]}}),
    "unknown input": lambda c: c["sweep"].update(axes={"gain.x_rol": {"values": [1]}}),
    "unknown design": lambda c: c["sweep"].update(design="sobel"),
    "unknown key": lambda c: c["sweep"].update(axis={}),
    "unknown signal": lambda c: c["sweep"]["reduce"]["rms"].update(signal="rol"),
    "unknown reducer": lambda c: c["sweep"]["reduce"]["rms"].update(how="mrs"),
    "no such function": lambda c: c["sweep"]["reduce"]["rms"].update(how="json:nothing"),
    "no such module": lambda c: c["sweep"]["reduce"]["rms"].update(how="nowhere_at_all:f"),
    "no signal": lambda c: c["sweep"]["reduce"].update(x={"how": "rms"}),
    "nothing to keep": lambda c: c["sweep"].update(reduce={}),
    "a name that is taken": lambda c: c["sweep"]["reduce"].update(
        Ixx={"how": "rms", "signal": "roll"}
    ),
    "against no flight": lambda c: c["sweep"]["reduce"]["rms"].update(how="nrmse"),
    "sizes that do not zip": lambda c: c["sweep"].update(
        design="list", axes={"Ixx": {"values": [0.1, 0.2]}, "a": {"values": [5]}}
    ),
    "designs that do not zip": lambda c: c["sweep"].update(
        design="zip",
        axes={},
        of=[
            {"design": "lhs", "n": 3, "axes": {"a": {"lower": 4, "upper": 5}}},
            {"design": "list", "axes": {"Ixx": {"values": [0.1, 0.2]}}},
        ],
    ),
    "n that is missing": lambda c: c["sweep"].update(
        design="sobol", axes={"a": {"lower": 4, "upper": 5}}
    ),
    "n that is missing, deep down": lambda c: c["sweep"].update(
        design="product",
        axes={},
        of=[
            {"design": "list", "axes": {"a": {"values": [5]}}},
            {"design": "zip", "of": [{"design": "lhs", "axes": {"If": {}}}]},
        ],
    ),
    "more than anyone can wait for": lambda c: c["sweep"].update(
        axes={n: {"lower": 1, "upper": 2, "n": 100_000} for n in ("Ixx", "If", "a")}
    ),
    "a name that is no folder": lambda c: c["sweep"]["reduce"].update(
        {"a/b": {"how": "rms", "signal": "roll"}}
    ),
    "a name of a dimension": lambda c: c["sweep"]["reduce"].update(
        mode={"how": "rms", "signal": "roll"}
    ),
    "a gain of no loop": lambda c: c["sweep"]["reduce"]["rms"].update(gain=2.0),
    "a signal of modes": lambda c: c["sweep"]["reduce"].update(
        m={"how": "modes", "signal": "roll"}
    ),
    "points for a sample": lambda c: c["sweep"].update(
        design="lhs", n=3, axes={"a": {"values": [4]}}
    ),
    "no table": lambda c: c["sweep"].update(design="table"),
    "a table that is not there": lambda c: c["sweep"].update(
        design="table", file="gone.csv", axes={"Ixx": {}}
    ),
    "a file for a grid": lambda c: c["sweep"].update(file="x.csv"),
    "a unit of another kind": lambda c: c["sweep"]["axes"]["Ixx"].update(unit="m"),
    "a seed without disturbance": lambda c: c["sweep"].update(axes={"seed": {"values": [1]}}),
    "an unknown solver": lambda c: c["sweep"].update(solver="Tsit6"),
    "an abstract solver": lambda c: c["sweep"].update(solver="AbstractSolver"),
    "a solver that steps cannot be fixed for": lambda c: c["sweep"].update(solver="Kvaerno5"),
    "trim of a roll model": lambda c: c["sweep"].update(start={"forward_speed": 1.0}),
    "chunks of nothing": lambda c: c["sweep"].update(chunk=0),
    "margins without input": lambda c: c["sweep"]["reduce"].update(
        m={"how": "margins", "signal": "roll"}
    ),
    "trajectories of nothing": lambda c: c["sweep"].update(trajectories={"signals": ["rol"]}),
    "a vehicle that lacks something": lambda c: c.update(model="helicopter"),
}


DRAWN = {"disturbance": {"axis": "roll", "sigma_w": 1.0, "tau_w": 1.0}}


@pytest.mark.parametrize(
    ("design", "axis"),
    [("grid", {"lower": 0, "upper": 3, "n": 7}), ("list", {"values": [0.5]}),
     ("sobol", {"lower": 0, "upper": 3}), ("list", {"values": [-1]})],
)  # fmt: skip
def test_seeds_that_are_no_whole_numbers_are_refused(design, axis, write, tmp_path, capsys):
    more = {"n": 4} if design == "sobol" else {}
    config = content(design=design, axes={"seed": axis}, **more) | DRAWN
    assert cli.main(["sweep", str(write(config)), "--out", str(tmp_path / "out")]) == 2


def test_seeds_from_a_range_are_exact(write, tmp_path):
    config = content(axes={"seed": {"lower": 0, "upper": 9, "n": 10}}) | DRAWN
    out = tmp_path / "out"
    assert cli.main(["sweep", str(write(config)), "--out", str(out), "--no-figures"]) == 0
    found = opened(out)
    assert found["seed"].values.tolist() == list(range(10))
    assert len(set(found["rms"].values.tolist())) == 10


def test_a_disturbance_that_nothing_draws_is_said(write, tmp_path, capsys):
    out = tmp_path / "out"
    config = content() | DRAWN
    assert cli.main(["sweep", str(write(config)), "--out", str(out), "--no-figures"]) == 0
    assert [n["code"] for n in opened(out).attrs["notes"]] == ["sweep.nothing-drawn"]


def test_nested_designs_draw_each_their_own(write, tmp_path):
    def lhs(name, **more):
        axes = {name: {"lower": 1e-4, "upper": 1e-3}}
        return {"design": "lhs", "n": 200, "axes": axes, **more}

    one = {"design": "list", "axes": {"a": {"values": [5.0]}}}
    nested = {"design": "product", "of": [one, lhs("If")]}
    deeper = {"design": "zip", "of": [nested, lhs("Ixx")]}
    parts = [deeper, lhs("L1"), lhs("L2", seed=1)]
    config = content(design="zip", axes={}, of=parts)
    path = write(config)
    from heli_jax import config as configuration
    from heli_jax import generate
    from heli_jax.config.sweeps import sweep_job

    values = sweep_job(*generate.drive(configuration.load(path, []))).design.values(0, 200)
    r = np.corrcoef([values[n] for n in ("If", "Ixx", "L1", "L2")])
    assert np.abs(r - np.eye(4)).max() < 0.3


OWN = {
    "turned into NumPy": "np.max(np.asarray(run.outputs.roll))",
    "a branch": "1.0 if run.outputs.roll[0] > 0 else 2.0",
    "no such output": "run.outputs.rol",
    "complex": "run.outputs.roll[0].astype(complex)",
    "a text": "'hello'",
    "its own error": "1 / 0",
    "an array": "run.outputs.roll",
    "a name that is none": "{'a/b': 1.0}",
}


@pytest.mark.parametrize("case", OWN)
def test_a_function_that_cannot_be_computed_is_named(case, write, tmp_path, capsys):
    # Folders stay on the path, so a process has one module of a name.
    module = f"own_functions_{list(OWN).index(case)}"
    (tmp_path / f"{module}.py").write_text(
        f"import numpy as np\n\n\ndef of_mine(run):\n    return {OWN[case]}\n"
    )
    config = content(reduce={"own": {"how": f"{module}:of_mine"}})
    out = tmp_path / "out"
    assert cli.main(["sweep", str(write(config)), "--out", str(out)]) == 2
    shown = capsys.readouterr().err.strip()
    assert len(shown.splitlines()) == 1
    assert not out.exists()


def test_numbers_that_the_summary_leaves_out_are_counted(write, tmp_path, capsys):
    loop = {"how": "margins", "signal": "roll", "input": "x_roll"}
    reduce = {"far": {**loop, "gain": -1e-9}, "lost": {**loop, "gain": -1e6}}
    out = tmp_path / "out"
    path = write(content(reduce=reduce))
    assert cli.main(["sweep", str(path), "--out", str(out), "--no-figures"]) == 0
    found = json.loads((out / "summary.json").read_text())
    data = opened(out)
    for name in ("far_gain", "far_phase", "lost_gain", "lost_phase"):
        values, one = data[name].values, found["results"][name]
        assert one.get("infinite", 0) == np.count_nonzero(np.isinf(values))
        assert one.get("nan", 0) == np.count_nonzero(np.isnan(values))
        assert one["n"] == np.count_nonzero(np.isfinite(values))
    # Resumed after its end, it still states its time.
    before = found["timing"]
    assert cli.main(["sweep", str(path), "--out", str(out), "--no-figures", "--resume"]) == 0
    assert json.loads((out / "summary.json").read_text())["timing"] == before


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_ends_in_one_sentence(case, write, tmp_path, capsys):
    config = content()
    WRONG[case](config)
    out = tmp_path / "out"
    assert cli.main(["sweep", str(write(config)), "--out", str(out)]) == 2
    shown = capsys.readouterr().err.strip()
    assert len(shown.splitlines()) == 1
    assert shown.startswith("heli-jax: ")
    assert not out.exists()


def test_another_configuration_does_not_go_on_with_a_store(write, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["sweep", str(write(content())), "--out", str(out)]) == 0
    other = write(content(axes={"Ixx": {"lower": 0.02, "upper": 0.06, "n": 6}}))
    before = (out / "sweep.zarr" / "zarr.json").read_bytes()
    assert cli.main(["sweep", str(other), "--out", str(out), "--resume"]) == 2
    assert cli.main(["sweep", str(other), "--out", str(out)]) == 2
    assert cli.main(["sweep", str(other), "--resume"]) == 2
    assert before == (out / "sweep.zarr" / "zarr.json").read_bytes()


def test_without_dask_the_extra_is_named(write, tmp_path):
    program = (
        "import sys\nsys.modules['distributed'] = None\nfrom heli_jax import cli\n"
        f"sys.exit(cli.main(['sweep', {str(write(content()))!r}, '--scheduler=x', '--out', 'o']))"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert run.returncode == 2
    assert "heli_jax[distributed]" in run.stderr
    assert not (tmp_path / "o").exists()
