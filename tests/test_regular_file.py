"""Files that are not regular or far too large end in one sentence, fast and without memory.

Every command runs in a process with limited memory and time, so that a fault costs one test only.
"""

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from heli_jax.cli import main
from heli_jax.errors import InputError
from heli_jax.flights import describe_log
from heli_jax.regular_file import read_regular, require_regular

ROOT = Path(__file__).parents[1]
TB = 10**12

# Run commands one after the other, each with a limit of time and memory.
DRIVER = """
import contextlib, io, json, resource, signal, sys
from heli_jax.cli import main
import heli_jax.config, heli_jax.config.sweeps, heli_jax.sweeps.run, pyarrow.csv, pyarrow.parquet
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 3 * 10**9,) * 2)
def late(*_):
    raise TimeoutError("the command hangs")
signal.signal(signal.SIGALRM, late)
found = []
for arguments in json.load(open(sys.argv[1])):
    said = io.StringIO()
    signal.alarm(int(sys.argv[2]))
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            code = main(arguments)
    except BaseException as e:
        code = f"{type(e).__name__}: {e}"
    signal.alarm(0)
    found.append([code, said.getvalue()])
print(json.dumps(found))
"""


def commands(folder, arguments, seconds=10, **how):
    """Return (exit code, standard error) of each command, from one process with limits."""
    (folder / "driver.py").write_text(DRIVER)
    (folder / "arguments.json").write_text(json.dumps(arguments))
    line = [sys.executable, str(folder / "driver.py"), str(folder / "arguments.json"), str(seconds)]
    run = subprocess.run(
        line, capture_output=True, text=True, timeout=120, check=False, cwd=folder, **how,
        env={**os.environ, "PYTHONPATH": f"{ROOT}"},
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    return json.loads(run.stdout)


def sparse(path):
    with path.open("wb") as file:
        file.truncate(TB)
    return path


def link(path, target):
    path.symlink_to(target)
    return path


def special_files(folder, ending):
    """Objects in place of a file, by the message about them."""
    folder.mkdir()
    pipe, folder_itself = folder / f"pipe{ending}", folder / f"folder{ending}"
    os.mkfifo(pipe)
    folder_itself.mkdir()
    with socket.socket(socket.AF_UNIX) as server:  # the name remains when it is closed
        server.bind(os.path.relpath(folder / f"socket{ending}"))
    return [
        (link(folder / f"zero{ending}", "/dev/zero"), "got a device"),
        (link(folder / f"random{ending}", "/dev/urandom"), "got a device"),
        (link(folder / f"stdin{ending}", "/proc/self/fd/0"), "got a pipe"),
        (pipe, "got a pipe"),
        (link(folder / f"linked{ending}", pipe), "got a pipe"),
        (folder / f"socket{ending}", "got a socket"),
        (folder_itself, "got a folder"),
        (sparse(folder / f"sparse{ending}"), "got 1 TB"),
        (link(folder / f"far{ending}", folder / f"sparse{ending}"), "got 1 TB"),
        (link(folder / f"circle{ending}", folder / f"circle{ending}"), "cannot be read"),
        (link(folder / f"nothing{ending}", folder / "none"), "no such file"),
    ]


@pytest.fixture
def configuration(tmp_path):
    """Return a function that writes the demo's configuration with changes and returns its path."""
    content = yaml.safe_load((ROOT / "configs" / "bench-gusts.yaml").read_text())
    content["vehicle"] = str(ROOT / "configs" / "vehicles" / "bench-30.yaml")
    count = iter(range(1000))

    def write(**changed):
        path = tmp_path / f"c{next(count)}.yaml"
        path.write_text(yaml.safe_dump({**content, **changed}, sort_keys=False))
        return str(path), content

    return write


def test_special_files_in_every_place_end_in_a_sentence(tmp_path, monkeypatch, configuration):
    monkeypatch.chdir(tmp_path)  # a socket's name must be short
    yamls, logs = special_files(tmp_path / "y", ".yaml"), special_files(tmp_path / "c", ".csv")
    parquets = special_files(tmp_path / "p", ".parquet")
    cases = [(["check", str(path)], words) for path, words in yamls]
    cases += [(["check", configuration(vehicle=str(p))[0]], words) for p, words in yamls]
    for path, words in logs + parquets:
        flight = {**configuration()[1]["flights"][0], "log": str(path)}
        cases.append((["check", configuration(flights=[flight])[0]], words))
        cases.append((["info", str(path)], words))
        table = {
            "design": "table", "file": str(path), "axes": {"Ixx": {}},
            "reduce": {"peak": {"how": "max", "signal": "roll"}},
        }  # fmt: skip
        config = configuration(sweep={**table, "inputs": "simulate"})[0]
        cases.append((["sweep", config, "--out", str(tmp_path / "out")], words))
    sparse(tmp_path / "large.py")
    os.mkfifo(tmp_path / "waits.py")
    cases.append((["check", configuration(model="large:model")[0]], "got 1 TB"))
    cases.append((["check", configuration(model="waits:model")[0]], "waits"))
    # Output is not written into a pipe, nor over it.
    pipe = str(tmp_path / "c" / "pipe.csv")
    cases.append((["simulate", configuration()[0], "--out", pipe], "is a pipe"))
    cases.append((["fit", configuration()[0], "--out", pipe], "exists already"))
    found = commands(tmp_path, [arguments for arguments, _ in cases], stdin=subprocess.PIPE)
    for (arguments, words), (code, said) in zip(cases, found, strict=True):
        lines = [line for line in said.splitlines() if line]
        assert code == 2, (arguments, code, said)
        assert len(lines) == 1, (arguments, said)
        assert words in lines[0], (arguments, words, said)
    assert os.path.exists(pipe)


@pytest.mark.slow
def test_a_terminal_is_no_configuration(tmp_path):
    master, slave = os.openpty()
    try:
        name = os.ttyname(slave)
        found = commands(tmp_path, [["check", name], ["info", "/dev/stdin"]], stdin=slave)
    finally:
        os.close(master)
        os.close(slave)
    assert [code for code, _ in found] == [2, 2]
    assert all("got a device" in said for _, said in found)


@pytest.mark.slow
def test_a_sweep_goes_on_only_in_a_directory_of_files(tmp_path, configuration):
    sweep = {
        "design": "grid", "inputs": "simulate", "axes": {"Ixx": {"values": [0.03, 0.04]}},
        "reduce": {"peak": {"how": "max", "signal": "roll"}},
    }  # fmt: skip
    out = tmp_path / "out"
    simulate = {**configuration()[1]["simulate"], "duration": 2}
    config = configuration(sweep=sweep, simulate=simulate)[0]
    arguments = ["sweep", config, "--out", str(out), "--no-figures"]
    assert main(arguments) == 0

    hidden = [
        ("sweep.zarr/zarr.json", os.mkfifo),
        ("sweep.zarr/peak/zarr.json", lambda path: link(path, "/dev/zero")),
        ("sweep.zarr/status/c/0", sparse),
        ("summary.json", os.mkfifo),
        (".lock", os.mkfifo),
    ]
    again = []
    for i, (name, make) in enumerate(hidden):
        copy = tmp_path / f"copy{i}"
        shutil.copytree(out, copy)
        (copy / name).unlink(missing_ok=True)
        make(copy / name)
        again.append(["sweep", config, "--out", str(copy), "--no-figures", "--resume"])
    *refused, whole = commands(tmp_path, [*again, [*arguments, "--resume"]], 60)
    for (name, _), (code, said) in zip(hidden, refused, strict=True):
        assert code == 2
        assert name in said
    assert whole[0] == 0


def test_a_file_that_grows_while_it_is_read_is_no_larger_than_stated():
    # A file of /proc is a regular file of size zero, and this one has 256 TB.
    assert os.stat("/proc/self/pagemap").st_size == 0
    with pytest.raises(InputError, match="expected a configuration of at most 1 MB, got more"):
        read_regular("/proc/self/pagemap", "a configuration", 10**6)


def test_the_limit_is_included(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"x" * 1000)
    assert require_regular(path, "a file", 1000) == 1000
    assert read_regular(path, "a file", 1000) == b"x" * 1000
    with pytest.raises(InputError):
        read_regular(path, "a file", 999)


def parquet_of(path, columns):
    pq.write_table(pa.table(columns), path)
    return path


TEXTS = {
    "many columns": ",".join(f"c{i}" for i in range(100_000)) + "\n1,2\n",
    "a long header": "t" * 2_000_000 + "\n1\n",
    "a long line": "t,phi\n0,0\n" + "," * 20_000_000 + "\n",
    "no header in sight": "\n" * 5_000_000 + "t,phi\n0,0\n",
    "comments without end": "# x\n" * 1_000_000 + "t,phi\n0,0\n",
    "the last row is short": "t,phi\n" + "0,0\n" * 500_000 + "1\n",
    "the last cell is text": "t,phi\n" + "0,0\n" * 500_000 + "1,x\n",
    "a quote without end": "t,phi\n" + "0,0\n" * 200_000 + '0,"',
}


def test_text_that_costs_more_than_its_size(tmp_path):
    cases = []
    for name, text in TEXTS.items():
        path = tmp_path / f"{name}.csv"
        path.write_text(text)
        cases.append(str(path))
    line = "from heli_jax.flights import read_flight, Signal"
    program = tmp_path / "program.py"
    program.write_text(
        f"{line}\nimport json, resource, sys, time\nfrom heli_jax.errors import InputError\n"
        "import pyarrow.csv\n"
        "found = []\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + 15 * 10**8,) * 2)\n"
        "for path in sys.argv[1:]:\n"
        "    begin = time.monotonic()\n"
        "    try:\n"
        "        read_flight(path, time='t', inputs={'u': Signal('phi', 'rad', 'rad')},\n"
        "                    outputs={})\n"
        "        said = 'read'\n"
        "    except InputError as e:\n"
        "        said = str(e)\n"
        "    found.append([said, time.monotonic() - begin])\n"
        "print(json.dumps(found))\n"
    )
    run = subprocess.run(
        [sys.executable, str(program), *cases], capture_output=True,
        text=True, timeout=120, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    for path, (said, seconds) in zip(cases, json.loads(run.stdout), strict=True):
        assert said.startswith(path)
        assert seconds < 20.0, path


def test_a_small_parquet_file_that_claims_much(tmp_path):
    # Equal values need no space in a file, but their full size in memory.
    zeros = pa.array(np.zeros(10**6))
    many = pa.chunked_array([zeros] * 101)
    path = parquet_of(tmp_path / "rows.parquet", {"t": many})
    assert path.stat().st_size < 10**6
    with pytest.raises(InputError, match="at most"):
        describe_log(path)
    few = pa.chunked_array([zeros] * 10)
    path = parquet_of(tmp_path / "cells.parquet", {f"c{i}": few for i in range(31)})
    with pytest.raises(InputError, match="at most"):
        describe_log(path)
    wide = parquet_of(tmp_path / "wide.parquet", {f"c{i}": [0.0] for i in range(10_001)})
    with pytest.raises(InputError, match="at most 10000 columns, got 10001"):
        describe_log(wide)


def test_a_parquet_file_without_an_end_is_not_hashed(tmp_path):
    path = tmp_path / "large.parquet"
    with path.open("wb") as file:
        file.truncate(15 * 10**9)
    with pytest.raises(InputError, match="no whole Parquet file"):
        describe_log(path)
    with path.open("r+b") as file:  # an end that declares the whole file a header
        file.seek(-8, 2)
        file.write((2**31).to_bytes(4, "little") + b"PAR1")
    with pytest.raises(InputError, match=r"footer of at most 64 MB, got 2\.15 GB"):
        describe_log(path)
