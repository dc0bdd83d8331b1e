"""The flybarless model on a real log, where the log is."""

import runpy
from pathlib import Path

import pytest

from heli_jax import Problem, fit

ROOT = Path(__file__).parents[2]
LOG = ROOT.parent / "shared" / "data" / "trex550" / "Pitchtest.csv"


@pytest.mark.skipif(not LOG.exists(), reason="the T-Rex 550 log is not part of the project")
def test_the_rate_loop_follows_the_doublets():
    experiment = runpy.run_path(str(ROOT / "experiments" / "trex550.py"))
    model, params, free = experiment["flybarless"](str(LOG), feedforward=False)
    window = experiment["read"](str(LOG), window=experiment["WINDOW"])
    estimate = fit(Problem(model, params, [window], free))
    assert estimate.status == "converged"
    seen = experiment["agreement"](model, params, estimate, experiment["read"](str(LOG)))
    # The Kim-Tilbury structure reached 0.979 in the window, a first-order lag 0.938 of the whole.
    assert seen["18-32 s"] > 0.979
    assert seen["whole"] > 0.938
    # The log has the stick late by about 0.2 s.
    assert -0.25 < estimate.estimates["delay_lat"].value < -0.1
