"""The README's Python runs as it stands."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_python_of_the_readme_runs():
    parts = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(parts) == 2
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join(parts)],
        capture_output=True, text=True, cwd=ROOT, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    status, estimates, gradients, best = run.stdout.strip().split("\n", 3)
    assert status.startswith("converged The data alone determine only a/Ixx and a/If")
    assert "'Ixx': (0.024" in estimates
    assert gradients.startswith("[")
    assert len(best.split()) == 2
