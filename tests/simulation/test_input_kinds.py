"""Kinds of input that a configuration names: what `simulate` makes of them."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import config, generate
from heli_jax.errors import InputError
from heli_jax.simulation.inputs import chirp

VEHICLE = Path(__file__).parents[2] / "configs" / "vehicles" / "bench-30.yaml"


@pytest.fixture
def stick(tmp_path):
    """The input that a configuration with these keys makes, in SI."""

    def stick(**keys):
        content = {
            "model": "roll-on-stand",
            "vehicle": str(VEHICLE),
            "simulate": {
                "duration": 4.0,
                "rate": 50,
                "inputs": {"x_roll": {"amplitude": 3.0, "unit": "um", **keys}},
            },
        }
        path = tmp_path / "study.yaml"
        path.write_text(yaml.safe_dump(content))
        return generate.drive(config.load(path, [])).flight.inputs["x_roll"]

    return stick


def test_a_chirp_of_a_configuration(stick):
    u = stick(kind="chirp", band=[0.5, 5.0])
    np.testing.assert_allclose(u, 3e-6 * chirp(u.size, 0.02, 0.5, 5.0), rtol=1e-12)


def test_the_old_kind_sweep_is_a_chirp_and_warns(stick):
    with pytest.warns(DeprecationWarning, match="kind: sweep is deprecated, expected chirp"):
        u = stick(kind="sweep", band=[0.5, 5.0])
    np.testing.assert_array_equal(u, stick(kind="chirp", band=[0.5, 5.0]))


def test_an_unknown_kind_names_those_there_are(stick):
    with pytest.raises(InputError, match=r"inputs\.x_roll\.kind.*chirp"):
        stick(kind="chrip")
