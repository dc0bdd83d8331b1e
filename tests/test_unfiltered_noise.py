"""Detection of a stated low-pass that the log did not go through, by its noise."""

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from heli_jax import load_config
from heli_jax.config.logs import read_flights

FAST, EVERY = 1000, 10
T = np.arange(30 * FAST) / FAST

CONFIG = """model: {linear: roll-flybarless}
flights:
  - log: flight.csv
    signals:
      time: {signal: t}
      inputs: {lat: {signal: lat, unit: "1"}}
      outputs: {p: {signal: p, unit: rad/s, filter: [{kind: KIND, hz: HZ}]}}
fit:
  free: {Lb: {start: 100}}
"""


def cautions(folder, kind, hz, passed, step):
    rng = np.random.default_rng(5)
    stick = 0.4 * np.sign(np.sin(2.1 * T)) * np.sin(0.31 * T)
    rate = lfilter([0.01], [1, -0.99], stick) + 0.05 * rng.standard_normal(T.size)
    if passed:
        if kind == "biquad":
            rate = lfilter(*butter(2, hz, fs=FAST), rate)
        else:
            share = 1 - np.exp(-2 * np.pi * hz / FAST)
            rate = lfilter([share], [1, share - 1], rate)
    rate = np.round(rate / step) * step if step else rate
    rows = np.column_stack([T, stick, rate])[::EVERY]
    np.savetxt(folder / "flight.csv", rows, "%.6g", ",", header="t,lat,p", comments="")
    path = folder / "flight.yaml"
    path.write_text(CONFIG.replace("KIND", kind).replace("HZ", str(hz)))
    (flight,) = read_flights(load_config(path))
    return [c for c in flight.source.cautions if c.code == "filters.not-passed"]


@pytest.mark.parametrize(("kind", "hz"), [("biquad", 20), ("pt1", 8)])
@pytest.mark.parametrize("step", [0.0, 0.0175])
def test_noise_above_a_stated_low_pass_is_told(tmp_path, kind, hz, step):
    (caution,) = cautions(tmp_path, kind, hz, passed=False, step=step)
    assert caution.subjects == ("p",)
    assert caution.value > 0.6
    assert not cautions(tmp_path, kind, hz, passed=True, step=step)


def test_a_low_pass_that_leaves_the_noise_is_not_doubted(tmp_path):
    # Logged at 100 Hz, noise behind a 30 Hz filter folds and is nearly white, with the filter and
    # without.
    assert not cautions(tmp_path, "biquad", 30, passed=False, step=0.0)
