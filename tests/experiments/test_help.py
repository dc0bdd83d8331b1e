"""Every file of experiments/ has --help."""

import subprocess
import sys
from pathlib import Path

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
SCRIPTS = sorted([*EXPERIMENTS.glob("*.py"), *EXPERIMENTS.glob("benchmarks/*.py")])
# The files are read and not run, since each import takes a second.
PARTS = [p for p in SCRIPTS if "by itself it does nothing" in p.read_text(encoding="utf-8")]


def test_each_file_answers_when_it_is_called() -> None:
    silent = [p.name for p in SCRIPTS if "__main__" not in p.read_text(encoding="utf-8")]
    assert not silent


def test_a_part_of_other_scripts_says_so() -> None:
    assert {p.stem for p in PARTS} == {
        *("script", "r50_record", "kernels"),
        *("corpus_cases", "corpus_records", "corpus_matrix"),
    }
    command = [sys.executable, str(EXPERIMENTS / "script.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    assert "by itself it does nothing" in done.stdout
