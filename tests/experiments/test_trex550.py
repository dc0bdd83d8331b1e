"""The flybarless model on a real log, where the log is."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOG = ROOT.parent / "shared" / "data" / "trex550" / "Pitchtest.csv"


@pytest.mark.skipif(not LOG.exists(), reason="the T-Rex 550 log is not part of the project")
def test_the_shipped_rate_loop_follows_the_log():
    experiment = runpy.run_path(str(ROOT / "experiments" / "trex550.py"))
    # As the configuration has it: the estimates, rounded.
    model, params, _ = experiment["flybarless"](str(LOG), feedforward=False)
    seen = experiment["agreement"](model, params, experiment["read"](str(LOG)))
    # The Kim-Tilbury structure reached 0.979 in the window, a first-order lag 0.938 of the whole.
    assert seen["18-32 s"] > 0.979
    assert seen["whole"] > 0.938
