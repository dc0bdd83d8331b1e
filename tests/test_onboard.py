"""The section `onboard` of a configuration."""

import numpy as np
import pytest
import yaml

from heli_jax import config as configuration
from heli_jax import models
from heli_jax.errors import InputError
from heli_jax.linear_models.read import linear_model
from heli_jax.workflow import run_check

ONBOARD = {
    "servos": {"on": ["lat"], "delay": True},
    "rate_loop": {"on": ["lat"], "feedforward": False},
    "sensors": {"lowpass": ["p"], "delay": {"phi": "tau_ahrs"}, "order": 2},
    "delays": {"inputs": ["lat"]},
}
VALUES = {
    "omega_servo": {"value": 8.0, "unit": "Hz", "source": "data sheet"},
    "zeta_servo": 0.7,
    "delay_servo": {"value": 10.0, "unit": "ms"},
    "Kp_lat": 0.05,
    "Ki_lat": 0.2,
    "Kc_lat": 3.0,
    "tau_lowpass_p": 0.02,
    "tau_ahrs": 0.05,
    "delay_lat": 0.04,
}
ROLL = {
    "model": {"linear": "roll-flybarless"},
    "onboard": ONBOARD,
    "vehicle": VALUES,
    "flights": [
        {
            "log": "roll.csv",
            "signals": {
                "time": {"signal": "t"},
                "inputs": {"lat": {"signal": "stick", "unit": "1"}},
                "outputs": {"p": {"signal": "p", "unit": "deg/s", "sd": 1.0}},
            },
        }
    ],
    "fit": {"free": {"Kc_lat": {"start": 2.0}, "delay_lat": {"start": 0.0}}},
    "simulate": {"duration": 8, "rate": 25, "inputs": {"lat": {"amplitude": 0.3}}},
}


@pytest.fixture
def written(tmp_path):
    """Return written(key=value, ...), the path of the configuration with these keys."""

    def written(**content):
        path = tmp_path / "roll.yaml"
        path.write_text(yaml.safe_dump({**ROLL, **content}, sort_keys=False))
        return path

    return written


def test_devices_stand_around_a_linear_model(written, tmp_path):
    found = configuration.load(written())
    model = models.with_servos(linear_model("roll-flybarless").model, ["lat"], delay=True)
    model = models.with_rate_loop(model, ["lat"], feedforward=False)
    model = models.with_sensors(model, ["p"], {"phi": "tau_ahrs"}, order=2)
    assert found.model is models.with_delays(model, inputs=["lat"])
    np.testing.assert_allclose(found.vehicle.params.omega_servo, 2 * np.pi * 8)
    np.testing.assert_allclose(found.vehicle.params.Lb, 166.1)
    assert found.vehicle.constants["Lb"].source == "CMU-RI-TR-00-03"
    # The resolved configuration describes the same experiment.
    again = tmp_path / "config.yaml"
    again.write_text(yaml.safe_dump(configuration.resolved(found)))
    same = configuration.load(again)
    assert same.model is found.model
    assert same.vehicle.params == found.vehicle.params


def test_a_helicopter_has_them_too(written, vehicles_folder):
    vehicle = yaml.safe_load((vehicles_folder / "bench-30.yaml").read_text())
    content = {
        "model": "roll-on-stand",
        "onboard": {"servos": [{"on": ["x_roll"], "rate_limit": True, "name": "cyclic"}]},
        "vehicle": {**vehicle, "omega_cyclic": 50.0, "zeta_cyclic": 0.7, "rate_cyclic": 0.1},
    }
    found = configuration.load(written(**content))
    assert not found.model.linear
    np.testing.assert_allclose(found.vehicle.params.rate_cyclic, 0.1)
    wrong = {**content, "vehicle": {**content["vehicle"], "R1": 1.0}}
    with pytest.raises(InputError, match="R1 must be less than R2"):
        configuration.load(written(**wrong))


@pytest.mark.parametrize(
    "content",
    [
        {"onboard": {"servo": {}}},
        {"onboard": {"servos": {"on": "lat"}}},
        {"onboard": {"servos": {}}},
        {"onboard": {"servos": {"on": ["ped"]}}},
        {"onboard": {"sensors": {"imu": True}}},
        {"onboard": {"gyro": {}}},
        {"onboard": {"delays": {"outputs": ["p"], "order": 9}}},
        {"vehicle": {**VALUES, "omega_servo": -1.0}},
        {"vehicle": {**VALUES, "omega_serv": 1.0}},
    ],
)
def test_errors_are_sentences(written, content):
    with pytest.raises(InputError):
        configuration.load(written(**content))


def test_a_value_that_nobody_gave_is_named(written, tmp_path):
    rest = {n: v for n, v in VALUES.items() if n not in ("zeta_servo", "delay_lat")}
    t = np.arange(100) * 0.04
    rows = np.column_stack([t, np.sign(np.sin(3 * t)), np.cos(3 * t)])
    np.savetxt(tmp_path / "roll.csv", rows, delimiter=",", header="t,stick,p", comments="")
    # A start value in the fit is enough for delay_lat.
    with pytest.raises(InputError, match="zeta_servo missing"):
        run_check(written(vehicle=rest))
