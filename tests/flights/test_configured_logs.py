"""Configurations with channels of autopilot logs, with the same keys as for columns."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import config
from heli_jax.errors import InputError

from .test_autopilot_logs import some_ulog
from .test_blackbox import some_flight, some_values

BENCH = Path(__file__).parents[2] / "configs" / "bench-gusts.yaml"


def configured(tmp_path, flight):
    content = yaml.safe_load(BENCH.read_text())
    content["vehicle"] = str((BENCH.parent / content["vehicle"]).resolve())
    content["flights"] = [flight]
    path = tmp_path / "flight.yaml"
    path.write_text(yaml.safe_dump(content))
    return config.read_flights(config.load(path))


def test_channels_of_two_clocks(tmp_path):
    some_ulog(tmp_path)
    signals = {
        "inputs": {"x_roll": {"signal": "manual_control_setpoint.x", "unit": "um"}},
        "outputs": {"roll": {"signal": "vehicle_angular_velocity[0].xyz[0]", "unit": "rad"}},
    }
    flight = {"log": "flight.ulg", "signals": signals, "rate": 100, "window": [0.1, 0.9]}
    (read,) = configured(tmp_path, flight)
    assert (read.dt, read.n_samples) == (0.01, 81)
    assert read.window == pytest.approx((0.1, 0.9))
    assert "windows.cut" not in {n.code for n in read.source.notes}
    (longer,) = configured(tmp_path, flight | {"window": [0.1, 9.0]})
    # The stick ends first, at 49/50 s.
    cut = [n.value for n in longer.source.notes if n.code == "windows.cut"]
    assert cut == [pytest.approx(0.98)]
    at = 0.1 + np.arange(81) / 100
    stick = 1e-6 * np.interp(at, np.arange(50) / 50, np.cos(np.arange(50) / 5))
    np.testing.assert_allclose(read.inputs["x_roll"], stick, atol=1e-11)
    with pytest.raises(InputError):
        configured(tmp_path, flight | {"signals": signals | {"time": {"signal": "t"}}})


def test_one_flight_of_several(tmp_path):
    (tmp_path / "LOG.TXT").write_bytes(some_flight() * 2)
    signals = {
        "inputs": {"x_roll": {"signal": "motor", "unit": "um", "hold": "zero-order"}},
        "outputs": {"roll": {"signal": "gyroADC[0]", "unit": "deg"}},
    }
    flight = {"log": "LOG.TXT", "signals": signals, "rate": 500}
    (read,) = configured(tmp_path, flight | {"flight": 2})
    assert read.inputs["x_roll"][0] == pytest.approx(1e-6 * some_values()[0, 6])
    with pytest.raises(InputError):
        configured(tmp_path, flight)


def test_a_table_needs_its_clock(tmp_path):
    (tmp_path / "b.csv").write_text("t,x,y\n" + "\n".join(f"{i},{i},1" for i in range(20)))
    signals = {"inputs": {"x_roll": {"signal": "x"}}, "outputs": {"roll": {"signal": "y"}}}
    with pytest.raises(InputError):
        configured(tmp_path, {"log": "b.csv", "signals": signals})
