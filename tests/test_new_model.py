"""`heli-jax new-model`: the skeleton runs unchanged, and its page is correct."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from heli_jax import new_model
from heli_jax.cli import main
from heli_jax.errors import InputError

ROOT = Path(__file__).parents[1]


def run(folder, *arguments):
    # Python finds the skeleton's module beside it, without writing compiled files there.
    done = subprocess.run(
        [sys.executable, "-W", "error", *arguments], capture_output=True, text=True, cwd=folder,
        check=False, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip
    assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]
    return done.stdout


@pytest.mark.slow
def test_the_skeleton_passes_its_own_test(tmp_path, capsys):
    assert main(["new-model", "swing", "--out", str(tmp_path / "swing")]) == 0
    said = capsys.readouterr()
    names = {Path(line).name for line in said.out.splitlines()}
    assert names == {"swing.py", "swing.yaml", "swing-vehicle.yaml", "test_swing.py"}
    assert names == {p.name for p in (tmp_path / "swing").iterdir()}
    assert "heli-jax simulate" in said.err
    out = run(tmp_path / "swing", "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_swing.py")
    assert "2 passed" in out


def test_what_it_writes_is_in_the_house_s_style(tmp_path):
    new_model.write_skeleton("swing", tmp_path / "swing")
    options = ["--isolated", "--no-cache", "--line-length", "100", "--select", "E,F,W,B,UP,NPY"]
    run(tmp_path / "swing", "-m", "ruff", "check", *options, ".")


@pytest.mark.parametrize("name", ["9x", "a-b", "class", "../x", "rôle", "numpy", "json"])
def test_names_that_no_module_can_have(tmp_path, name):
    with pytest.raises(InputError):
        new_model.write_skeleton(name, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_folder_that_exists_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "swing").mkdir()
    assert main(["new-model", "swing"]) == 2
    assert list((tmp_path / "swing").iterdir()) == []


def test_the_page_s_python_runs(tmp_path):
    (program,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs/own-models.md").read_text(), re.DOTALL
    )
    out = run(tmp_path, "-c", program)
    assert out.startswith("converged")
    value, sd = map(float, re.findall(r"'Lp': \((-?[\d.]+), ([\d.]+)\)", out)[0])
    assert abs(value + 4.0) < 4 * sd < 0.5
