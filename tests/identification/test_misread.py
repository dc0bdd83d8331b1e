"""Numbers that are hardly what they are taken for, from the table to the first line of a fit."""

import numpy as np
import pytest
import yaml

from heli_jax import config as configuration
from heli_jax.config.logs import read_flights
from heli_jax.flights.stick_dropouts import stick_dropouts
from heli_jax.identification.validation.misread import doubt_words, dropouts, misread

DT, N = 0.02, 1000
T = DT * np.arange(N)
U = 0.1 * np.sign(np.sin(2.3 * T) + 0.5 * np.sin(5.1 * T)) + 0.02 * np.sin(11.0 * T)
P = 0.4 * np.sin(1.7 * T) + 0.2 * np.cos(4.3 * T)


@pytest.fixture
def load(tmp_path):
    """load(p, u, unit=..., **p's keys) -> the problem of a table of them."""

    def load(p, u=U, unit="", **of_p):
        rows = ["t,lat,p", *([f"s,,{unit}"] if unit else [])]
        rows += [f"{t:.2f},{a:.9g},{b:.9g}" for t, a, b in zip(T, u, p, strict=True)]
        (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
        signals = {
            "time": {"signal": "t"},
            "inputs": {"lat": {"signal": "lat"}},
            "outputs": {"p": {"signal": "p", **of_p}},
        }
        content = {
            "model": {"linear": "roll-flybarless"},
            "flights": [{"log": "log.csv", "signals": signals}],
            "fit": {"free": {"Blat": {"start": 0.1}}},
        }
        path = tmp_path / "config.yaml"
        path.write_text(yaml.safe_dump(content))
        return configuration.load(path)

    return load


def flights(experiment):
    return read_flights(experiment)


def of(found):
    """The parts of a problem that these questions ask for."""
    from types import SimpleNamespace

    from heli_jax import linear_model

    return SimpleNamespace(training=found, model=linear_model("roll-flybarless").model)


def _doubts(found):
    return doubt_words((*misread(found), *dropouts(found)))


def test_the_unit_of_the_file_is_taken_where_none_is_stated(load):
    [flight] = flights(load(np.degrees(P), unit="deg/s"))
    np.testing.assert_allclose(flight.outputs["p"], P, rtol=1e-7, atol=1e-9)
    assert "p: no unit stated, 'p' taken in deg/s, as the file says" in flight.source.notes
    [plain] = flights(load(P))
    np.testing.assert_allclose(plain.outputs["p"], P, rtol=1e-7, atol=1e-9)


def test_degrees_that_are_read_as_radians_are_doubted(load):
    found = of(flights(load(np.degrees(P))))
    assert _doubts(found) == ("p looks like deg/s read as rad/s",)
    [one] = misread(found)
    assert "state unit: deg/s" in one.finding.sentence
    assert _doubts(of(flights(load(P)))) == ()


def test_dropouts_are_no_measurements_and_can_be_stated(load):
    p = P.copy()
    p[np.random.default_rng(1).choice(N, 20, replace=False)] = 0.0
    found = of(flights(load(p)))
    assert _doubts(found) == ("dropouts of p are taken for measurements",)
    [one] = dropouts(found)
    assert "state missing: 0 beside its signal" in one.finding.sentence
    [flight] = flights(load(p, missing=0))
    assert np.isnan(flight.outputs["p"]).sum() == 20
    assert dropouts(of([flight])) == []


def test_a_stick_that_drops_out():
    u = np.round(U, 4)
    gone = np.random.default_rng(1).choice(np.arange(5, N - 5, 7), 12, replace=False)
    u[gone] = -1.0
    value, at = stick_dropouts(u) or (None, None)
    assert value == -1.0
    np.testing.assert_array_equal(np.flatnonzero(at), np.sort(gone))
    # A stick between three positions rests where it is.
    assert stick_dropouts(np.repeat([0.0, 0.1, 0.0, -0.1] * 25, 10)) is None
