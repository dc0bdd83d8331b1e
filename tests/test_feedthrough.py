"""Outputs that follow an input within a sample."""

from heli_jax import config as configuration
from heli_jax.config.feedthrough import follows
from heli_jax.flights import Signal

HEAVE = """
name: heave
states: {w: m/s, nu: m/s}
inputs: {col: "1"}
outputs: {az: m/s^2, w: m/s}
parameters:
  Zw: {value: -1, unit: 1/s}
  tn: {value: 0.3, unit: s, positive: true}
  Zc: {value: 0, unit: m/s^2}
  Kn: {value: 0.5, unit: m/s}
A:
  w: {w: Zw, nu: -1/tn}
  nu: {nu: -1/tn}
B:
  w: {col: Zc}
  nu: {col: Kn/tn}
C: {az: {w: Zw}, w: {w: 1}}
D: {az: {col: Zc}}
"""

CONFIG = """
model: {linear: heave.yaml}
flights:
  - log: log.csv
    signals:
      time: {signal: t}
      inputs: {col: {signal: u}}
      outputs: {az: {signal: a%s}, w: {signal: w}}
fit:
  free: {Zc: {start: %s}, tn: {start: 0.2}}
"""


def found(folder, rate, start, more="", hold="auto"):
    (folder / "heave.yaml").write_text(HEAVE)
    (folder / "fit.yaml").write_text(CONFIG % (more, start))
    experiment = configuration.load(folder / "fit.yaml")
    return follows(experiment, rate, {"col": Signal("u", "1", "1", hold=hold)})


def test_an_acceleration_jumps_with_the_stick_and_a_speed_does_not(tmp_path):
    assert found(tmp_path, 40.0, -20) == {("col", "az"): True}
    # A coefficient that starts at zero is unknown, so the output counts.
    assert found(tmp_path, 40.0, 0) == {("col", "az"): True}
    # Behind the autopilot's filter it follows within a sample at 20 Hz, but not at 200 Hz.
    filtered = ", filter: {kind: pt1, hz: 30}"
    assert found(tmp_path, 20.0, -20, filtered) == {("col", "az"): False}
    assert found(tmp_path, 400.0, -20, filtered) == {}
    # The pairs are not needed without resampling or without a held input.
    assert found(tmp_path, None, -20) == found(tmp_path, 40.0, -20, hold="linear") == {}
