"""Starts by equation error, against least squares by hand and known truth.

Also with gaps and hidden states, and with messages where it is impossible.
"""

import math
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Model, linear_model, load_config, models
from heli_jax.config import problem
from heli_jax.errors import InputError
from heli_jax.identification.equation_error.start import bridged, equation_error_start, smoothed
from heli_jax.naming import Scalar

DT = 0.02
UNKNOWN = Free()


class Params(NamedTuple):
    Lp: Annotated[Scalar, "1/s", "roll damping"]
    Lda: Annotated[Scalar, "1/s^2", "aileron's effect"]
    Lphi: Annotated[Scalar, "1/s^2", "a stiffness that no aircraft has"]


class State(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate"]
    phi: Annotated[Scalar, "rad", "bank angle"]


class Inputs(NamedTuple):
    da: Annotated[Scalar, "rad", "aileron"]


def vector_field(q, x, u):
    return State(p=q.Lp * x.p + q.Lphi * x.phi + q.Lda * u.da, phi=x.p)


def both(q, x, u):
    return State(p=x.p, phi=x.phi)


ROLL = Model("roll", vector_field, both, Params, State, Inputs, State, linear=True)
NOTHING = Params(math.nan, math.nan, math.nan)
FREE = {"Lp": UNKNOWN, "Lda": UNKNOWN, "Lphi": UNKNOWN}


def record(seed=0, n=1500, gust=0.0, noise=0.0):
    """Return p' = -4 p + 25 da + gust with a held input, by its exact recursion; phi by Simpson."""
    rng = np.random.default_rng(seed)
    da = np.repeat(rng.uniform(-0.1, 0.1, n // 10), 10)
    a = math.exp(-4.0 * DT)
    keeps = math.exp(-DT / 0.3)
    w = scipy.signal.lfilter(
        [gust * math.sqrt(1 - keeps**2)], [1, -keeps], rng.standard_normal(da.size)
    )
    pushed = (1 - a) / 4.0 * (25.0 * da + w)
    p = np.r_[0.0, scipy.signal.lfilter([1.0], [1.0, -a], pushed)[:-1]]
    # phi' = p exactly, with p = -p'/4 + (25 da + w)/4 between samples.
    phi = -(p - p[0]) / 4.0 + np.r_[0.0, np.cumsum(25.0 * da + w)[:-1]] * DT / 4.0
    y = {n: v + noise * rng.standard_normal(da.size) for n, v in (("p", p), ("phi", phi))}
    return Flight(dt=DT, inputs={"da": da}, outputs=y)


def values(start):
    return {n: v.value for n, v in start.values.items()}


@pytest.mark.parametrize("width", [1.2, 4.8])
def test_smoothing_keeps_polynomials_and_a_linear_equation(width):
    t = DT * np.arange(200)
    y, first, second = smoothed(1.0 + 2.0 * t - 3.0 * t**2, DT, width, mode="constant")
    seen = np.isfinite(y)
    assert seen.sum() == 200 - 2 * round(5.0 * width)
    np.testing.assert_allclose(second[seen], -6.0, rtol=0.02)
    np.testing.assert_allclose(first[seen], 2.0 - 6.0 * t[seen], rtol=1e-3, atol=1e-3)
    # The mean of s^2 under the kernel moves a parabola by a constant, its shape stays.
    assert np.ptp((y - (1.0 + 2.0 * t - 3.0 * t**2))[seen]) < 1e-9


def test_short_gaps_are_bridged_and_long_ones_stay():
    y = np.arange(40.0)
    y[10:12] = y[20:26] = np.nan
    filled = bridged(y)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(filled)), np.arange(20, 26))
    np.testing.assert_allclose(filled[10:12], [10.0, 11.0])


def test_without_any_value_it_finds_what_least_squares_by_hand_finds():
    flight = record(noise=1e-3)
    start = equation_error_start(ROLL, NOTHING, [flight], FREE)
    # By hand: the exact difference equation of the held input, whose coefficients give Lp and Lda.
    p, da = flight.outputs["p"], flight.inputs["da"]
    a, b = np.linalg.lstsq(np.stack([p[:-1], da[:-1]], axis=1), p[1:], rcond=None)[0]
    by_hand = {"Lp": math.log(a) / DT, "Lda": b * math.log(a) / DT / (a - 1.0)}
    found = values(start)
    assert found["Lp"] == pytest.approx(by_hand["Lp"], rel=0.02)
    assert found["Lda"] == pytest.approx(by_hand["Lda"], rel=0.02)
    assert found["Lp"] == pytest.approx(-4.0, rel=0.02)
    assert abs(found["Lphi"]) < 0.05
    assert [e.name for e in start.equations] == ["p"]
    assert start.equations[0].r_squared > 0.99


def test_an_angle_alone_shows_its_rate_and_gaps_do_no_harm():
    flight = record(noise=1e-4)
    phi = flight.outputs["phi"].copy()
    phi[300:340] = phi[700:702] = phi[1100:1190] = np.nan
    gappy = replace(flight, outputs={"phi": phi})
    found = values(equation_error_start(ROLL, NOTHING, [gappy], FREE))
    assert found["Lp"] == pytest.approx(-4.0, rel=0.05)
    assert found["Lda"] == pytest.approx(25.0, rel=0.05)


def test_products_with_a_state_that_is_not_measured():
    """Test the rotor's flapping: Lb and Blat act as a product, and Lb alone."""
    file = linear_model("roll-flybarless")
    p = file.vehicle().params
    truth = {n: float(getattr(p, n)) for n in ("Lb", "Blat", "tau_f")}
    rng = np.random.default_rng(4)
    lat = np.repeat(rng.uniform(-0.2, 0.2, 150), 10)
    # phi p b with b' = -p - b/tau + Blat/tau lat, discretised by scipy.
    A = np.array([[0, 1, 0], [0, 0, truth["Lb"]], [0, -1, -1 / truth["tau_f"]]])
    B = np.array([[0], [0], [truth["Blat"] / truth["tau_f"]]])
    Ad, Bd, *_ = scipy.signal.cont2discrete((A, B, np.eye(3), np.zeros((3, 1))), DT)
    x, states = np.zeros(3), []
    for u in lat:
        states.append(x)
        x = Ad @ x + Bd[:, 0] * u
    phi, rate, _ = np.array(states).T
    flight = Flight(dt=DT, inputs={"lat": lat}, outputs={"phi": phi, "p": rate})
    start = equation_error_start(file.model, p, [flight], dict.fromkeys(truth, UNKNOWN))
    found = start.values
    assert found["Lb"].value == pytest.approx(truth["Lb"], rel=0.05)
    assert found["Blat"].value == pytest.approx(truth["Blat"], rel=0.05)
    assert (found["tau_f"].value, found["tau_f"].origin) == (truth["tau_f"], "vehicle")
    assert start.hidden == ("b",)
    # A time constant of an unmeasured state needs a given value.
    without = p._replace(tau_f=math.nan)
    with pytest.raises(ValueError, match=r"free\.tau_f\.start"):
        equation_error_start(file.model, without, [flight], dict.fromkeys(truth, UNKNOWN))


def test_what_cannot_be_regressed_is_refused(bench30):
    flight = record(n=300)
    sum_alone = Model("sum", vector_field, total, Params, State, Inputs, Total, linear=True)
    only = Flight(dt=DT, inputs=flight.inputs, outputs={"total": flight.outputs["p"]})
    with pytest.raises(ValueError, match="total"):
        equation_error_start(sum_alone, NOTHING, [only], FREE)
    with pytest.raises(ValueError, match="linear"):
        equation_error_start(models.helicopter("paper"), bench30, [flight], {"Ixx": UNKNOWN})
    short = Flight(
        dt=DT,
        inputs={"da": flight.inputs["da"][:20]},
        outputs={"p": flight.outputs["p"][:20], "phi": flight.outputs["phi"][:20]},
    )
    with pytest.raises(ValueError, match="missing samples"):
        equation_error_start(ROLL, NOTHING, [short], FREE)


LAG = """
name: lag
states: {p: rad/s}
inputs: {da: rad}
outputs: {p: rad/s}
parameters: {tau: {value: 1, unit: s}, K: {value: 1, unit: 1/s}}
A: {p: {p: -1/tau}}
B: {p: {da: K/tau}}
"""


@pytest.mark.parametrize("vehicle", [{}, {"tau": -0.2, "K": 1.0}])
def test_a_parameter_that_something_is_divided_by(tmp_path, vehicle):
    (tmp_path / "lag.yaml").write_text(LAG)
    model = linear_model(tmp_path / "lag.yaml").model
    params = model.Params(**{"tau": math.nan, "K": math.nan, **vehicle})
    flight = record()
    only = replace(flight, outputs={"p": flight.outputs["p"]})
    free = {"tau": UNKNOWN, "K": UNKNOWN}
    found = values(equation_error_start(model, params, [only], free))
    # 1 / 4 and 25 / 4, as from regressions on the two terms of the same record.
    known = Params(math.nan, math.nan, 0.0)
    two = {"Lp": UNKNOWN, "Lda": UNKNOWN}
    terms = values(equation_error_start(ROLL, known, [only], two))
    assert found["tau"] == pytest.approx(-1.0 / terms["Lp"], rel=1e-4)
    assert found["K"] == pytest.approx(-terms["Lda"] / terms["Lp"], rel=1e-4)


SUM = """
name: sum
states: {p: rad/s}
inputs: {da: rad}
outputs: {p: rad/s}
parameters: {La: {value: -1, unit: 1/s}, Lb: {value: -2, unit: 1/s}, Lda: {value: 1, unit: 1/s^2}}
A: {p: {p: La + Lb}}
B: {p: {da: Lda}}
"""


def test_exchangeable_parameters_have_the_right_sum(tmp_path):
    (tmp_path / "sum.yaml").write_text(SUM)
    file = linear_model(tmp_path / "sum.yaml")
    flight = record()
    only = replace(flight, outputs={"p": flight.outputs["p"]})
    free = dict.fromkeys(("La", "Lb", "Lda"), UNKNOWN)
    found = values(equation_error_start(file.model, file.vehicle().params, [only], free))
    assert found["La"] + found["Lb"] == pytest.approx(-4.0, rel=0.02)
    assert found["Lda"] == pytest.approx(25.0, rel=0.02)


class Total(NamedTuple):
    total: Annotated[Scalar, "rad", "of both states"]


def total(q, x, u):
    return Total(total=x.p + x.phi)


MODEL = """
name: aileron
states: {p: rad/s}
inputs: {da: rad}
outputs: {p: rad/s}
parameters: {Lp: {value: -1, unit: 1/s}, Lda: {value: 1, unit: 1/s^2}}
A: {p: {p: Lp}}
B: {p: {da: Lda}}
"""
CONFIG = """
model: {linear: aileron.yaml}
flights:
  - log: log.csv
    signals:
      time: {signal: t}
      inputs: {da: {signal: da, unit: rad, hold: zero-order}}
      outputs: {p: {signal: p, unit: rad/s}}
fit:
  start: equation-error
  free: {Lp: {}, Lda: {lower: 26.0}}
rls: null
"""


@pytest.fixture
def config(tmp_path):
    flight = record(n=600, noise=2e-3)
    table = np.stack([flight.times, flight.inputs["da"], flight.outputs["p"]], axis=1)
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,da,p", comments="")
    (tmp_path / "aileron.yaml").write_text(MODEL)
    (tmp_path / "fit.yaml").write_text(CONFIG)
    return tmp_path / "fit.yaml"


@pytest.mark.parametrize(
    ("place", "override"),
    [
        # The model file's value, which a bound of the fit excludes.
        (r"free\.Lda\.start", {"fit.start": "given"}),
        (r"fit\.free", {"fit.free": {"Lpp": {}}}),
        (r"fit\.start", {"fit.start": "guess"}),
    ],
)
def test_wrong_starts_are_refused_with_their_place(config, place, override):
    with pytest.raises(InputError, match=place):
        problem(load_config(config, override))
