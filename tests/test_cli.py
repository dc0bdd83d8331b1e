"""Command line: exit codes, sentences and files."""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import models, run_directory
from heli_jax.cli import jax_settings, main
from heli_jax.errors import InputError
from heli_jax.linear_models.read import shipped

ROOT = Path(__file__).parents[1]
TREX = ROOT.parent / "shared" / "data" / "trex550" / "Pitchtest.csv"


@pytest.fixture(scope="module")
def bench_log(tmp_path_factory):
    """Text of a short log of the demo's bench."""
    path = tmp_path_factory.mktemp("bench") / "bench.csv"
    how = ["--set", "simulate.duration=12", "--out", str(path)]
    assert main(["simulate", str(ROOT / "configs" / "bench-gusts.yaml"), *how]) == 0
    return path.read_text()


@pytest.fixture
def bench(tmp_path, bench_log):
    """Return the path of the demo's configuration with a short log, in its own folder."""
    content = yaml.safe_load((ROOT / "configs" / "bench-gusts.yaml").read_text())
    content["vehicle"] = str(ROOT / "configs" / "vehicles" / "bench-30.yaml")
    content["flights"][0]["log"] = "bench.csv"
    content["simulate"]["duration"] = 12
    content["fit"]["starts"] = 1
    path = tmp_path / "bench.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    (tmp_path / "bench.csv").write_text(bench_log)
    return path


def edited(path, change):
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def refused(capsys, arguments, *words):
    """Assert exit code 2, one sentence on standard error, and no output."""
    capsys.readouterr()
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as e:
        code = e.code
    out, err = capsys.readouterr()
    assert code == 2
    lines = [line for line in err.splitlines() if line]
    assert len(lines) == 1, err
    assert "Traceback" not in err
    for word in words:
        assert str(word) in lines[0], lines[0]
    assert out == ""


def test_fit_writes_a_whole_run_directory(bench, capsys):
    out = bench.parent / "run"
    assert main(["fit", str(bench), "--out", str(out)]) == 0
    assert {p.name for p in out.iterdir()} == {
        "config.yaml", "fit.json", "signals.csv", "report.html", "figures",
    }  # fmt: skip
    result = json.loads((out / "fit.json").read_text())
    assert result["status"] == "converged"
    assert result["identifiable"] is True
    assert (result["adequate"], result["exit_code"]) == (True, 0)
    assert result["adequacy"]["judged"][0]["output"] == "roll"
    assert {c["name"] for c in result["determined_combinations"]} == {"a/Ixx", "a/If"}
    assert result["parameters"]["a"]["prior_share"] > 0.95
    assert result["n_samples"] == 600
    assert len(result["baseline_rls"]["theta"]) == 9
    assert len(result["data"][0]["sha256"]) == 64
    assert {"jax", "heli_jax", "python"} <= set(result["versions"])
    assert {p.suffix for p in (out / "figures").iterdir()} == {".svg"}
    assert not list(bench.parent.glob(".run*"))
    # The resolved configuration also runs from another folder.
    again = bench.parent / "elsewhere"
    again.mkdir()
    (again / "again.yaml").write_text((out / "config.yaml").read_text())
    assert main(["check", str(again / "again.yaml")]) == 0


def test_three_free_end_with_exit_code_3(bench, capsys):
    edited(bench, lambda c: c["fit"]["free"]["a"].pop("prior"))
    out = bench.parent / "run"
    assert main(["check", str(bench)]) == 3
    assert main(["fit", str(bench), "--out", str(out)]) == 3
    result = json.loads((out / "fit.json").read_text())
    assert result["status"] == "not-identifiable"
    [null] = result["null_directions"]
    assert np.allclose(list(null.values()), 3**-0.5, atol=1e-3)
    assert {c["name"] for c in result["determined_combinations"]} == {"a/Ixx", "a/If"}
    assert result["parameters"]["Ixx"]["sd"] is None


def test_too_few_steps_end_with_exit_code_4(bench, capsys):
    out = bench.parent / "run"
    arguments = ["fit", str(bench), "--set", "fit.max_steps=2", "--out", str(out)]
    assert main(arguments) == 4
    written = json.loads((out / "fit.json").read_text())
    assert written["status"] == "not-converged"
    # The fit states where it stopped, without an interval.
    assert all(
        e["value"] is not None and e["sd"] is None and e["lower95"] is None
        for e in written["parameters"].values()
    )
    assert (written["adequate"], written["exit_code"]) == (None, 4)


def test_simulation_needs_the_size_of_the_disturbance(bench, capsys):
    edited(bench, lambda c: c.update(disturbance={"axis": "roll"}))
    refused(capsys, ["simulate", bench, "--out", bench.parent / "b.csv"])


def test_simulate_without_a_simulate_section_follows_the_flights(bench, capfd):
    edited(bench, lambda c: c.pop("simulate"))
    assert main(["simulate", str(bench)]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert lines[0].replace('"', "").split(",")[:4] == ["flight", "time", "x_roll", "roll"]
    assert len(lines) == 601


WRONG = {
    "unknown key": lambda c: c.update(vehicel=1),
    "unknown key below": lambda c: c["fit"].update(fre=1),
    "unknown model": lambda c: c.update(model="rol"),
    "model by path": lambda c: c.update(model="nowhere:here"),
    "unknown parameter": lambda c: c["fit"]["free"].update(Ixy={"start": 1.0}),
    "nothing free": lambda c: c["fit"].update(free={}),
    "start outside": lambda c: c["fit"]["free"]["Ixx"].update(start=2.0),
    "start nan": lambda c: c["fit"]["free"]["Ixx"].update(start=float("nan")),
    "negative inertia": lambda c: c["fit"]["free"].update(If={"start": -1e-4}),
    "missing column": lambda c: c["flights"][0]["signals"]["outputs"]["roll"].update(signal="ph"),
    "unknown unit": lambda c: c["flights"][0]["signals"]["outputs"]["roll"].update(unit="degre"),
    "unit of the wrong kind": lambda c: c["flights"][0]["signals"]["inputs"]["x_roll"].update(
        unit="deg"
    ),
    "plain stick": lambda c: c["flights"][0]["signals"]["inputs"]["x_roll"].update(unit="1"),
    "unknown output": lambda c: c["flights"][0]["signals"]["outputs"].update(rol={"signal": "phi"}),
    "unknown known": lambda c: c["flights"][0].update(known={"Ixx_aded": 1.0}),
    "no flights": lambda c: c.update(flights=[]),
    "missing log": lambda c: c["flights"][0].update(log="none.csv"),
    "missing vehicle": lambda c: c.update(vehicle="none.yaml"),
    "rotor at rest": lambda c: c.update(vehicle={**BENCH_30, "Omega": 0}),
    "paddle inside out": lambda c: c.update(vehicle={**BENCH_30, "R1": 0.3}),
    "vehicle nan": lambda c: c.update(vehicle={**BENCH_30, "c": float("nan")}),
    "vehicle incomplete": lambda c: c.update(
        vehicle={k: v for k, v in BENCH_30.items() if k != "R"}
    ),
    "reversed hold": lambda c: c["simulate"]["inputs"].update(
        x_roll={"amplitude": 1e-3, "hold": [2, 0.3]}
    ),
    "window outside": lambda c: c["flights"][0].update(window=[50, 60]),
    "too few samples": lambda c: c["flights"][0].update(window=[0, 0.1]),
    "method": lambda c: c["fit"].update(method="guess"),
    "filter without disturbance": lambda c: (
        c.pop("disturbance"),
        c["fit"].update(method="filter-error"),
    ),
    "disturbance on no axis": lambda c: (
        c["disturbance"].update(axis="pitch"),
        c["fit"].update(method="filter-error"),
    ),
    "negative disturbance": lambda c: c["disturbance"].update(sigma_w=-1.0),
    "disturbance without memory": lambda c: c["disturbance"].update(tau_w=0.0),
    "fixed but not given": lambda c: c.update(disturbance={"axis": "roll", "fixed": ["tau_w"]}),
    "noise parameter free": lambda c: (
        c["fit"]["free"].update(tau_w={"start": 1.0}),
        c["fit"].update(method="filter-error"),
    ),
    "forgetting": lambda c: c.update(rls={"forgetting": 1.5}),
    "noise fixed and not stated": lambda c: (
        c["disturbance"].update(fixed=["sigma_y"]),
        c["flights"][0]["signals"]["outputs"]["roll"].pop("sd"),
    ),
    "profile of what is fixed": lambda c: c["fit"].update(intervals={"profile": ["Iff"]}),
    "bootstrap with a time shift": lambda c: c["fit"].update(
        intervals={"bootstrap": 10}, nuisance={"time_shift": True}
    ),
}
BENCH_30 = yaml.safe_load((ROOT / "configs" / "vehicles" / "bench-30.yaml").read_text())


def test_models_are_listed_and_described(capsys):
    assert main(["models", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert set(listed) == {*models.names(), *(f"linear:{n}" for n in shipped())}
    assert all(listed.values())
    assert main(["models", "short-period", "--json"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in described["states"]] == ["alpha", "q"]
    assert all(row["source"] for row in described["parameters"])
    [mode] = described["modes"]
    assert float(mode["damping"]) == pytest.approx(2.505 / 3.606, abs=1e-3)
    assert main(["models", "helicopter"]) == 0
    assert main(["models", "nothing"]) == 2


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence(bench, capsys, case):
    edited(bench, WRONG[case])
    out = bench.parent / "run"
    refused(capsys, ["fit", bench, "--out", out])
    assert not out.exists()
    assert not list(bench.parent.glob(".run*"))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a: [1, 2",
        "- 1\n- 2\n",
        "model: roll\nmodel: pitch\n",
        "a: !!python/object/apply:os.system ['true']\n",
        "a: &a [*a]\n",
        "[" * 5000,
        "\x00\x01",
    ],
)
def test_broken_and_hostile_yaml(tmp_path, capsys, text):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    refused(capsys, ["check", path], path)


def test_an_input_that_never_moves(bench):
    """Test that a free decay can be fitted, but not parameters that only the input determines."""
    log = bench.parent / "bench.csv"
    rows = [line.split(",") for line in log.read_text().splitlines()]
    log.write_text("\n".join(",".join([r[0], r[1] if i == 0 else "1.0", r[2]])
                             for i, r in enumerate(rows)) + "\n")  # fmt: skip
    assert main(["fit", str(bench), "--out", str(bench.parent / "run")]) == 3
    written = json.loads((bench.parent / "run" / "fit.json").read_text())
    assert written["identifiable"] is False


def test_missing_samples(bench, capsys):
    """Test that a few missing samples are skipped with a note; too few left are an error."""
    log = bench.parent / "bench.csv"
    head, *rows = log.read_text().splitlines()
    at = head.replace('"', "").split(",").index("phi")

    def gone(row):
        cells = row.split(",")
        cells[at] = ""
        return ",".join(cells)

    few = [gone(r) if i % 50 in (3, 4) else r for i, r in enumerate(rows)]
    log.write_text("\n".join([head, *few]))
    out = bench.parent / "run"
    assert main(["fit", str(bench), "--out", str(out)]) == 0
    assert json.loads((out / "fit.json").read_text())["n_samples"] == 576
    many = [gone(r) if i % 100 else r for i, r in enumerate(rows)]
    log.write_text("\n".join([head, *many]))
    assert main(["fit", str(bench), "--out", str(bench.parent / "other")]) == 2


def test_usage_and_places_to_write(bench, capsys):
    (bench.parent / "there").mkdir()
    for arguments in (
        ["fly", bench],
        ["fits"],
        ["info"],
        ["compare", "a", "--jason"],
        ["fit", bench, "--set", "fit.free"],
        ["fit", bench, "--set", "flights.9.rate=1"],
        ["fit", bench, "--out", bench.parent / "there"],
        ["simulate", bench, "--out", bench.parent / "x.doc"],
        ["info", bench.parent / "none.csv"],
        ["fit", bench, "--workers", "0"],
        ["sweep", bench, "--devices", "two"],
    ):
        refused(capsys, arguments)


def test_a_device_that_is_not_there(bench, capsys, monkeypatch):
    import jax

    def none():
        raise AssertionError

    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr(jax, "devices", none)
    for command in (["fit", bench], ["sweep", bench], ["check", bench]):
        refused(capsys, command)


# Each interrupts itself at a moment when an exception would be lost, printed or late.
MOMENTS = {
    "a finaliser": """
        class Finalised:
            def __del__(self):
                signal.raise_signal(signal.SIGINT)
        Finalised()
        time.sleep(60)
    """,
    "compiled code": """
        threading.Timer(0.1, signal.raise_signal, [signal.SIGINT]).start()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
    """,
    "writing": """
        with run_directory.whole(pathlib.Path("run")) as folder:
            (folder / "half").write_text("half")
            with run_directory.whole_file(pathlib.Path("out.csv"), "out.csv") as part:
                part.write_text("half")
                for _ in range(3):
                    signal.raise_signal(signal.SIGINT)
    """,
    "ended by the system": """
        with run_directory.whole(pathlib.Path("run")) as folder:
            (folder / "half").write_text("half")
            signal.raise_signal(signal.SIGTERM)
    """,
    "ended in compiled code": """
        with run_directory.whole(pathlib.Path("run")) as folder:
            threading.Timer(0.1, signal.raise_signal, [signal.SIGTERM]).start()
            hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
    """,
    "after the work": """
        with run_directory.whole_file(pathlib.Path("done.csv"), "done.csv") as part:
            part.write_text("whole")
        signal.raise_signal(signal.SIGINT)
    """,
}


def as_program(script, arguments, folder):
    """Start a process that runs `main` like the command, with the shell's signal handling."""
    head = (
        "import hashlib, pathlib, signal, sys, threading, time\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from heli_jax import __main__, run_directory\nfrom heli_jax.cli import commands\n"
    )
    command = [
        sys.executable,
        "-c",
        f"{head}{script}\nsys.exit(__main__.main())",
        *map(str, arguments),
    ]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize("moment", MOMENTS)
def test_an_interrupt_ends_a_command_at_any_moment(tmp_path, moment):
    body = textwrap.indent(textwrap.dedent(MOMENTS[moment]), "    ")
    script = f"def busy(options):\n{body}\ncommands._info = busy"
    process = as_program(script, ["info", "log.csv"], tmp_path)
    out, err = process.communicate(timeout=30)
    done = moment == "after the work"
    assert (out, err) == ("", "heli-jax: interrupted\n")
    assert process.returncode == (143 if moment.startswith("ended") else 130)
    assert [path.name for path in tmp_path.iterdir()] == (["done.csv"] if done else [])


def test_an_interrupt_while_the_command_is_imported(tmp_path):
    """Test that heli_jax/__main__.py handles interrupts before it imports anything."""
    (tmp_path / "argparse.py").write_text("import signal; signal.raise_signal(signal.SIGINT)\n")
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from heli_jax.__main__ import main; sys.exit(main())"
    )
    # Python looks for modules in this folder first.
    ended = subprocess.run(
        [sys.executable, "-c", program, "--help"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (ended.returncode, ended.stdout) == (130, "")
    assert ended.stderr == "heli-jax: interrupted\n"


def test_interrupts_after_the_end_are_nothing(tmp_path):
    """Test an interrupt while Python shuts down, which takes a second."""
    script = "import atexit; atexit.register(signal.raise_signal, signal.SIGINT)\n"
    process = as_program(
        f"{script}commands._info = lambda options: 0", ["info", "log.csv"], tmp_path
    )
    assert process.communicate(timeout=30) == ("", "")
    assert process.returncode == 0


def test_who_stops_reading_is_no_failure_and_a_full_disk_is(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("t,p\n" + "".join(f"{0.01 * k},{k % 7}\n" for k in range(100)))
    command = [sys.executable, "-m", "heli_jax", "info", str(log)]
    # Python's buffer is larger than the output of info, so all is written at the end.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as nobody:
        ended = subprocess.run(
            command, stdout=nobody, stderr=subprocess.PIPE, text=True, env=environment
        )
    assert (ended.returncode, ended.stderr) == (0, "")
    full = Path("/dev/full")
    if full.exists():
        with full.open("w") as nowhere:
            ended = subprocess.run(
                command, stdout=nowhere, stderr=subprocess.PIPE, text=True, env=environment
            )
        assert ended.returncode == 2
        assert len(ended.stderr.splitlines()) == 1


def test_the_style_of_the_working_folder_is_passed_over(tmp_path):
    os.mkfifo(tmp_path / "matplotlibrc")
    script = "commands._info = lambda options: int(not __import__('matplotlib').__version__)"
    process = as_program(script, ["info", "log.csv"], tmp_path)
    assert process.communicate(timeout=60)[1] == ""


def test_what_was_compiled_is_kept_for_its_owner_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "heli_jax").mkdir(mode=0o777)
    assert jax_settings._private_cache() == str(tmp_path / "heli_jax")
    assert (tmp_path / "heli_jax").stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert jax_settings._private_cache() is None


def test_a_place_that_is_taken_meanwhile_is_refused(tmp_path):
    out = tmp_path / "run"
    with run_directory.whole(out) as folder:
        (folder / "fit.json").write_text("0")
    with pytest.raises(InputError), run_directory.whole(out) as folder:
        (folder / "fit.json").write_text("lost")
    # A regular file cannot contain a folder.
    below = out / "fit.json" / "a" / "b.csv"
    with pytest.raises(InputError), run_directory.whole_file(below, "--out"):
        pass
    with pytest.raises(InputError), run_directory.whole(below):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert (out / "fit.json").read_text() == "0"


def test_arguments_that_are_no_text_are_refused(capsys):
    refused(capsys, ["info", "log\udcff.csv"])


MODEL = """
from typing import NamedTuple

from heli_jax import Model


class Params(NamedTuple):
    Lp: float
    Lda: float


class State(NamedTuple):
    p: float


class Inputs(NamedTuple):
    da: float


class Outputs(NamedTuple):
    p: float


def field(q, x, u):
    return State(p=q.Lp * x.p + q.Lda * u.da)


rolling = Model("rolling", field, lambda q, x, u: Outputs(p=x.p), Params, State, Inputs, Outputs,
                linear=True)
"""


def test_a_model_that_is_not_linear_is_not_simulated_as_if_it_were(tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "bent_model.py").write_text(MODEL.replace("q.Lp * x.p", "q.Lp * x.p**2"))
    config = {
        "model": "bent_model:rolling",
        "vehicle": {"Lp": -1.0, "Lda": 1.0},
        "simulate": {"duration": 2, "rate": 50, "inputs": {}},
    }
    path = tmp_path / "bent.yaml"
    path.write_text(yaml.safe_dump(config))
    assert main(["simulate", str(path), "--out", str(tmp_path / "bent.csv")]) == 2
    assert not (tmp_path / "bent.csv").exists()


def test_a_model_of_ones_own(tmp_path, capsys):
    (tmp_path / "own_roll_model.py").write_text(MODEL)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 40), 25)
    p, decay = [0.0], np.exp(-4.0 * 0.02)
    for value in u[:-1]:
        p.append(decay * p[-1] + 2.5 / 4.0 * (1 - decay) * value)
    p = np.array(p) + 1e-3 * rng.standard_normal(1000)
    rows = [f"{0.02 * k:.2f},{a:.9g},{b:.9g}" for k, (a, b) in enumerate(zip(u, p, strict=True))]
    (tmp_path / "run.csv").write_text("t,u,p\n" + "\n".join(rows) + "\n")
    signals = {
        "time": {"signal": "t"},
        "inputs": {"da": {"signal": "u"}},
        "outputs": {"p": {"signal": "p"}},
    }
    config = {
        "model": "own_roll_model:rolling",
        "vehicle": {"Lp": -1.0, "Lda": 1.0},
        "flights": [{"log": "run.csv", "signals": signals}],
        "fit": {"free": {"Lp": {"start": -1.0}, "Lda": {"start": 1.0}}},
    }
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(config))
    assert main(["fit", str(path), "--out", str(tmp_path / "run")]) == 0
    estimates = json.loads((tmp_path / "run" / "fit.json").read_text())["parameters"]
    assert estimates["Lp"]["value"] == pytest.approx(-4.0, abs=4 * estimates["Lp"]["sd"])
    assert estimates["Lda"]["value"] == pytest.approx(2.5, abs=4 * estimates["Lda"]["sd"])
    assert estimates["Lp"]["lower95"] < estimates["Lp"]["value"] < estimates["Lp"]["upper95"] < 0


@pytest.mark.skipif(not TREX.exists(), reason="the real logs are not at ../shared/data")
@pytest.mark.parametrize(
    "flybar_free",
    [pytest.param(False, id="If-fixed", marks=pytest.mark.slow), pytest.param(True, id="If-free")],
)
def test_a_real_record(tmp_path, capsys, flybar_free):
    signals = {
        "time": {"signal": "t"},
        "inputs": {"x_roll": {"signal": "lat", "unit": "1"}},
        "outputs": {"roll_rate": {"signal": "p", "unit": "rad/s"}},
    }
    free = {"Ixx": {"start": 0.05}} | ({"If": {"start": 5e-4}} if flybar_free else {})
    config = {
        "model": "roll",
        "vehicle": str(ROOT / "configs" / "vehicles" / "bench-30.yaml"),
        "flights": [{"log": str(TREX), "signals": signals, "window": [18, 32]}],
        "fit": {"free": free, "nuisance": {"time_shift": True, "input_gain": True}},
    }
    path = tmp_path / "trex.yaml"
    path.write_text(yaml.safe_dump(config))
    code = main(["fit", str(path), "--out", str(tmp_path / "run")])
    result = json.loads((tmp_path / "run" / "fit.json").read_text())
    assert result["metrics"]["roll_rate"]["vaf"] >= 0.97
    # The flybar's inertia is hard to separate from a delay, so it gets no estimate.
    shift = result["nuisance"]["time_shift"]
    assert (shift["value"] is None) == (shift["sd"] is None)
    assert flybar_free or -0.25 < shift["value"] < -0.05
    assert not result["residuals"]["white"]
    if flybar_free:
        assert code in (0, 3)
        assert "Ixx" in result["verdict"]["text"]
        assert "gain x_roll" in result["verdict"]["text"]
        assert "If" in result["verdict"]["text"]
    else:
        assert code == 0


def test_quiet_hides_progress_and_no_doubt(tmp_path, bench_log, capsys):
    log, out = tmp_path / "bench.csv", tmp_path / "converted.csv"
    log.write_text(bench_log)
    capsys.readouterr()
    assert main(["convert", str(log), str(out), "--quiet"]) == 0
    said = capsys.readouterr().err
    assert "column 't' is taken as the clock in s" in said
    assert "wrote" not in said
