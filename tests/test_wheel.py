"""The wheel has every file of the package, and a fit runs from it without the source tree."""

import importlib.util
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

if importlib.util.find_spec("hatchling") is None:
    pytest.skip("hatchling is not installed (extra dev)", allow_module_level=True)

CONFIG = """
model: {linear: roll-flybarless}
flights:
  - log: roll.csv
    signals:
      time: {signal: t}
      inputs: {lat: {signal: lat, unit: "1"}}
      outputs: {p: {signal: p, unit: rad/s}}
fit:
  free: {Lb: {start: 100}, Blat: {start: 0.1}}
rls: null
simulate:
  duration: 10
  rate: 50
  inputs: {lat: {kind: 3-2-1-1, amplitude: 0.2, step: 0.3}}
  noise: {p: {sd: 0.01, unit: rad/s}}
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    build = ["-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    subprocess.run([sys.executable, *build, "--wheel-dir", folder, ROOT], check=True)
    [built] = folder.glob("heli_jax-*.whl")
    return built


def test_the_wheel_has_every_file_of_the_package(wheel):
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if name.startswith("heli_jax/")}
    files = (p for p in (ROOT / "heli_jax").rglob("*") if p.is_file())
    assert packed == {p.relative_to(ROOT).as_posix() for p in files if p.suffix != ".pyc"}


def test_a_log_is_simulated_described_and_fitted_from_the_wheel(wheel, tmp_path):
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    work = tmp_path / "work"
    work.mkdir()
    (work / "roll.yaml").write_text(CONFIG, encoding="utf-8")

    def python(*words):
        done = subprocess.run(
            [sys.executable, *words], capture_output=True, text=True, cwd=work, check=False,
            env=os.environ | {"PYTHONPATH": str(site)},
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    home = (
        "import heli_jax, heli_jax.versions; print(heli_jax.__file__, heli_jax.versions.version())"
    )
    place, version = python("-c", home).split()
    assert Path(place).is_relative_to(site)
    assert wheel.name.startswith(f"heli_jax-{version}-")
    heli_jax = ("-m", "heli_jax")
    python(*heli_jax, "simulate", "roll.yaml", "--out", "roll.csv")
    assert "lat" in python(*heli_jax, "info", "roll.csv")
    python(*heli_jax, "new", "roll.csv", "--out", "new.yaml")
    python(*heli_jax, "new-model", "mine")
    python(*heli_jax, "fit", "roll.yaml", "--out", "fit")
    assert (work / "fit" / "report.html").stat().st_size > 100_000
