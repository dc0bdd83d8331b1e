"""Test that the Python code of the README and of docs/python.md runs unchanged."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from heli_jax.cli import main
from heli_jax.yaml_file import parse_mapping

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the configurations and the log of `make demo`."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "configs", folder / "configs")
    config = folder / "configs/bench-roll.yaml"
    assert main(["simulate", str(config), "--out", str(folder / "runs/demo/bench.csv")]) == 0
    return folder


def parts(page):
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


def run(folder, program):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        capture_output=True, text=True, cwd=folder, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


PAGES = ("README.md", *(str(p.relative_to(ROOT)) for p in sorted(ROOT.glob("docs/**/*.md"))))


@pytest.mark.parametrize("page", PAGES)
def test_the_configurations_of_the_pages_are_yaml(page):
    for block in re.findall(
        r"```yaml[^\n]*\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL
    ):
        assert parse_mapping(block, page)


def test_the_readme_is_one_screen():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    for page in re.findall(r"\]\((docs/[^)#]*)\)", text):
        assert (ROOT / page).exists(), page


def test_from_a_log_to_estimates_intervals_a_figure_and_a_data_frame(folder):
    program = parts("docs/python.md")[0]
    # The README's code is a part of it, so one run tests both.
    [shown] = parts("README.md")
    assert [line for line in shown.splitlines()[4:8] if line not in program.splitlines()] == []
    assert len(program.strip().splitlines()) <= 16
    assert set(re.findall(r"from (\S+) import", program)) == {"heli_jax"}
    out = run(folder, program)
    assert "by output-error: converged" in out
    assert re.search(r"Ixx +0\.02\d+ .*kg m\^2", out)
    assert "'profile': (0.02" in out
    assert out.strip().splitlines()[-1].startswith("converged 0.02")
    assert (folder / "runs/notebook/response.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "runs/notebook/fit/report.html").exists()


@pytest.mark.slow
def test_the_python_of_the_page_runs(folder):
    assert len(parts("docs/python.md")) == 4
    out = run(folder, "\n".join(parts("docs/python.md")[1:]))
    status, estimates, gradients, best, booted = out.strip().split("\n", 4)
    assert status.startswith("converged")
    assert "'Ixx': (0.024" in estimates
    assert gradients.startswith("[")
    assert len(best.split()) == 2
    assert booted.startswith("(0.02")
