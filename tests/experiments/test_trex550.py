"""The flybarless model on a real log, if the log is available."""

import runpy
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
LOG = ROOT.parent / "shared" / "data" / "trex550" / "Pitchtest.csv"


@pytest.mark.skipif(not LOG.exists(), reason="the T-Rex 550 log is not part of the project")
def test_the_shipped_rate_loop_follows_the_log():
    experiment = runpy.run_path(str(ROOT / "experiments" / "trex550.py"))
    # The configuration has the rounded estimates.
    model, params, _ = experiment["flybarless"](str(LOG), feedforward=False)
    seen = experiment["agreement"](model, params, experiment["read"](str(LOG)))
    # The Kim-Tilbury structure reached 0.979 in the window, a first-order lag 0.938 of the whole.
    assert seen["18-32 s"] > 0.979
    assert seen["whole"] > 0.938


@pytest.mark.skipif(not LOG.exists(), reason="the T-Rex 550 log is not part of the project")
def test_the_rest_is_predicted_where_the_lateral_stick_moves():
    experiment = runpy.run_path(str(ROOT / "experiments" / "trex550.py"))
    model, params, _ = experiment["flybarless"](str(LOG), feedforward=False)
    log = experiment["read"](str(LOG))
    doublets = float(np.std(experiment["read"](str(LOG), window=(18.0, 32.0)).inputs["lat"]))
    t = np.arange(log.outputs["p"].size) * log.dt
    rest = (t < 18.0) | (t > 32.0)
    found = experiment["where_the_stick_moves"](model, params, log, doublets, rest)
    seconds, agreed = found[0.25]
    assert agreed > 0.90
    assert 10.0 < seconds < 25.0
    # The more the stick moves, the larger is its share of the rate.
    assert found[0.2][1] < agreed < found[0.3][1]
