"""Numbers with units in a configuration, and names that differ only in case."""

import math

import pytest
import yaml

from heli_jax import load_config
from heli_jax.errors import InputError, nearest


@pytest.fixture
def load(tmp_path):
    def load(**content):
        path = tmp_path / "roll.yaml"
        path.write_text(yaml.safe_dump({"model": {"linear": "roll-flybarless"}, **content}))
        return load_config(path)

    return load


def test_an_initial_state_may_have_a_unit(load):
    ten_degrees = {"value": 10, "unit": "deg/s"}
    found = load(
        initial_state={"p": ten_degrees, "phi": 0.1},
        disturbance={"on": ["p", "b"], "sigma_w": {"p": 3, "b": 2}, "tau_w": 0.2},
    )
    assert found.config.initial_state == pytest.approx({"p": math.radians(10), "phi": 0.1})
    start = found.model.initial_state(found.vehicle.params)
    assert float(start.p) == pytest.approx(math.radians(10))
    assert found.config.disturbance.parameters == pytest.approx(
        {"sigma_w_p": 3.0, "tau_w_p": 0.2, "sigma_w_b": 2.0, "tau_w_b": 0.2}
    )
    one = load(disturbance={"axis": "roll", "sigma_w": 3})
    assert one.config.disturbance.parameters == {"sigma_w": 3.0, "tau_w": None}


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (
            {"initial_state": {"p": {"value": 1, "unit": "deg"}}},
            "initial_state: p: unit 'deg' is an angle, expected an angular speed such as 'rad/s'",
        ),
        ({"initial_state": {"p": math.nan}}, "initial_state: p: expected a finite number, got nan"),
        ({"initial_state": {"p": {"unit": "deg/s"}}}, "expected a number under value"),
        ({"disturbance": {"on": ["p"], "sigma_w": {"value": 1}}}, "'value' is not disturbed"),
        (
            {"disturbance": {"on": ["p"], "sigma_w": 0}},
            "disturbance.sigma_w: got 0, expected number > 0",
        ),
        (
            {"disturbance": {"on": ["p", "b"], "sigma_w": 1}},
            "sigma_w: expected a value for each disturbance, as {p: 1, b: 1}, got one",
        ),
    ],
)
def test_wrong_ones_end_in_one_sentence(load, content, sentence):
    with pytest.raises(InputError, match=sentence):
        load(**content)


def test_a_name_that_is_wrong_in_its_case_alone_is_the_nearest():
    assert nearest("MA", ["Mq", "Ma", "Lb"]) == "; did you mean 'Ma'?"
    assert nearest("mq", ["MA", "Mq"]) == "; did you mean 'Mq'?"
    assert nearest("Mx", ["Mq", "Lb"]) == "; did you mean 'Mq'?"
