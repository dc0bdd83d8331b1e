"""Numbers that are probably misread, from the table to the first line of a fit."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import yaml

from heli_jax import Flight, linear_model, models
from heli_jax import config as configuration
from heli_jax.config.logs import read_flights
from heli_jax.flights.flight import Signal, Source
from heli_jax.identification.diagnostics import record, units

TREX = Path(__file__).parents[3] / "shared" / "data" / "trex550"
DT, N = 0.02, 1000
T = DT * np.arange(N)
U = 0.1 * np.sign(np.sin(2.3 * T) + 0.5 * np.sin(5.1 * T)) + 0.02 * np.sin(11.0 * T)
P = 0.4 * np.sin(1.7 * T) + 0.2 * np.cos(4.3 * T)


ROLL_AXES = linear_model("roll-flybarless").model.axes


class Motor(NamedTuple):
    tau: float


@pytest.fixture
def load(tmp_path):
    """Return load(p, u, unit=..., **p's keys), the flights of a table with these columns."""

    def load(p, u=U, unit="", unit_of_p=None, **of_p):
        of_p |= {} if unit_of_p is None else {"unit": unit_of_p}
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
        return read_flights(configuration.load(path))

    return load


RECORD_ALONE = (
    units.rate_against_angle, units.against_file, units.size_of_angles,
    record.saturation, record.stuck_outputs,
)  # fmt: skip


def record_doubts(c):
    return [f for diagnostic in RECORD_ALONE for f in diagnostic(c) if f.bad]


def denied(c):
    """Return (code, subjects) of findings that no model can explain these flights."""
    return [(f.code, f.subjects) for f in record_doubts(c) if f.denies]


IN_DOUBT, AGAINST_FILE = ("units.in-doubt", ("p",)), ("units.against-file", ("p",))


def of(flights):
    """Return the input of these diagnostics."""
    return SimpleNamespace(
        flights=[(str(i), f) for i, f in enumerate(flights)],
        problem=SimpleNamespace(model=linear_model("roll-flybarless").model),
        fitted=False,
        status="not-converged",
        estimates={},
    )


def test_the_unit_of_the_file_is_taken_where_none_is_stated(load):
    [flight] = load(np.degrees(P), unit="deg/s")
    np.testing.assert_allclose(flight.outputs["p"], P, rtol=1e-7, atol=1e-9)
    assert ("units.assumed", ("p",)) in [(n.code, n.subjects) for n in flight.source.notes]
    [plain] = load(P)
    np.testing.assert_allclose(plain.outputs["p"], P, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("size", [1.0, 20.0])
def test_a_unit_against_that_of_the_file_is_doubted(load, size):
    found = of(load(np.degrees(size * P), unit="deg/s", unit_of_p="rad/s"))
    assert [(f.code, f.subjects) for f in record_doubts(found)] == [AGAINST_FILE, IN_DOUBT]
    assert denied(found) == [IN_DOUBT]
    # A value that is small in either unit is a doubt, not a cause.
    small = of(load(0.1 * P, unit="deg/s", unit_of_p="rad/s"))
    [one] = record_doubts(small)
    assert (one.code, one.subjects, one.denies) == (*AGAINST_FILE, False)
    assert record_doubts(of(load(np.degrees(P), unit="deg/s", unit_of_p="deg/s"))) == []


def test_a_rate_that_a_helicopter_may_have_and_a_linear_model_may_not_is_only_doubted(load):
    fast = P * 12.0 / np.percentile(np.abs(P), 99)
    [one] = record_doubts(of(load(fast)))
    assert (one.code, one.subjects, one.denies) == (*IN_DOUBT, False)
    assert one.value == pytest.approx(12.0, rel=1e-6)


def test_degrees_that_are_read_as_radians_are_doubted(load):
    found = of(load(np.degrees(P)))
    assert denied(found) == [IN_DOUBT]
    assert len(record_doubts(found)) == 1
    assert record_doubts(of(load(P))) == []


def test_a_unit_in_doubt_takes_all_intervals(load):
    for size in (12.0 / np.percentile(np.abs(P), 99), 57.3):
        found = of(load(size * P))
        found.status, found.estimates = "converged", {"Lp": None}
        assert [f.distrusts for f in units.size_of_angles(found)] == [("Lp",)]


def test_dropouts_are_no_measurements_and_can_be_stated(load):
    p = P.copy()
    p[np.random.default_rng(1).choice(N, 20, replace=False)] = 0.0
    found = of(load(p))
    assert denied(found) == [("quality.dropouts", ("p",))]
    [flight] = load(p, missing=0)
    assert np.isnan(flight.outputs["p"]).sum() == 20
    assert record_doubts(of([flight])) == []


def test_flat_tops_are_no_measurements(load):
    rng = np.random.default_rng(2)
    noisy = P + 0.01 * rng.standard_normal(N)
    for limit, count in ((0.4, 1), (np.inf, 0)):
        problem = of(load(np.clip(noisy, -limit, limit), unit_of_p="rad/s"))
        assert denied(problem) == count * [("quality.saturation", ("p",))]


@pytest.mark.parametrize("every", [1, 10], ids=["every sample", "a tenth of them"])
def test_a_roll_that_was_flown_is_no_wrong_unit(every):
    p = np.where((T > 5) & (T < 8), 1.9, 0.0) + 0.1 * np.sin(3 * T)
    # An attitude is often logged more slowly than a gyro.
    phi = np.where(np.arange(p.size) % every == 0, np.cumsum(p) * DT, np.nan)
    signals = {
        "p": Signal("p", "rad/s", "rad/s"),
        "phi": Signal("phi", "rad", "rad"),
    }
    for of_rate, sure in ((1.0, False), (1 / 57.3, True)):
        flight = Flight(
            dt=DT,
            inputs={"lat": U},
            outputs={"p": p * of_rate, "phi": phi},
            source=Source("log.csv", "", outputs=signals),
        )
        [found] = units.size_of_angles(of([flight]))
        assert found.value == pytest.approx(5.7, rel=0.02)
        assert found.denies is sure
        assert (found.code, found.distrusts) == ("units.in-doubt", ())


@pytest.mark.skipif(not TREX.exists(), reason="the real logs are not at ../shared/data")
@pytest.mark.parametrize("name", ["Pitchtest.csv", "Hovertest.csv"])
def test_nothing_is_wrong_with_the_sticks_and_angles_of_a_real_log(name):
    log = np.genfromtxt(TREX / name, delimiter=",", names=True)
    for angle, rate in (("phi", "p"), ("theta", "q"), ("psi", "r")):
        ratio = units.angle_over_rate(log[angle], log[rate], 0.01)
        assert ratio is None or ratio.factor > 0


def test_the_shaft_of_a_motor_may_turn(load):
    found = of(load(100.0 * P, unit_of_p="rad/s"))
    assert denied(found) == [IN_DOUBT]
    [(_, flight)] = found.flights
    renamed = dataclasses.replace(
        flight,
        outputs={"speed": flight.outputs["p"]},
        source=dataclasses.replace(flight.source, outputs={"speed": flight.source.outputs["p"]}),
    )
    # It is neither an attitude nor a body rate, so its plausible speed is unknown.
    motor = dataclasses.replace(models.roll_on_stand, axes=(), Params=Motor)
    assert list(units.in_degrees(motor, "", renamed)) == []
    # Nor is the angle of a pendulum that goes over the top an attitude, whatever it is called.
    turning = {"phi": Signal("phi", "rad", "rad")}
    flight = Flight(
        dt=DT, inputs={"lat": U}, outputs={"phi": 6.0 * T}, source=Source("a", "", outputs=turning)
    )
    swing = dataclasses.replace(motor, axes=ROLL_AXES, linear=False)
    assert list(units.in_degrees(swing, "", flight)) == []
    helicopter = dataclasses.replace(swing, Params=models.roll_on_stand.Params)
    assert [f.denies for f in units.in_degrees(helicopter, "", flight)] == [True]
