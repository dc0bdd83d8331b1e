"""Operating points of nonlinear models for a record, against independent programs."""

from types import SimpleNamespace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal

from heli_jax import Flight, Helicopter, Model, models
from heli_jax.analysis.operating_point import modes_of_flight, operating_point
from heli_jax.identification.result import Signals
from heli_jax.report.fitted_responses import at_record
from tests.dynamics import whole_helicopter as oracle
from tests.responses import continuous

N, DT = 500, 0.04
STILL = dict.fromkeys(("x_roll", "x_pitch", "x_yaw", "x_throttle"), np.zeros(N))


@pytest.fixture(scope="module")
def hovering():
    """Return the independent program's z over throttle in hover, as a function of omega."""
    v = oracle.XCELL
    state, inputs = oracle.hover(v)["consistent"]
    A, h = oracle.jacobian("consistent", v, state, inputs), 1e-6
    up, down = (
        oracle.consistent_rates(v, state, {**inputs, "x_throttle": inputs["x_throttle"] + e})
        for e in (h, -h)
    )
    names = oracle.STATES["consistent"]
    b = np.array([(up[n] - down[n]) / (2 * h) for n in names])
    return lambda w: np.linalg.solve(1j * w * np.eye(A.shape[0]) - A, b)[names.index("z")]


@pytest.fixture(scope="module")
def xcell(vehicles_folder):
    return Helicopter(**{**oracle.XCELL, "Omega": 157.0})


def signals(outputs, inputs=STILL):
    t = np.arange(N) * DT
    return Signals("flight 1", False, t, inputs, outputs, outputs)


@pytest.mark.slow
def test_the_response_of_a_hovering_helicopter_is_that_of_hover(xcell, hovering):
    # At zero throttle the rotor is at rest, and the response would be zero.
    model = models.helicopter("consistent")
    fit = SimpleNamespace(nuisance={}, signals=(signals({"z": np.zeros(N)}),))
    at = at_record(model, xcell, fit)
    assert at.words == "the trim in hover"
    H = continuous(model, xcell, "z", "x_throttle", at)
    assert abs(hovering(1.0)) > 10.0
    for w in (0.5, 1.0, 5.0):
        assert H(np.array([w]))[0] == pytest.approx(hovering(w), rel=1e-4)


@pytest.mark.slow
def test_a_record_of_forward_flight_is_linearised_there(xcell):
    model, t = models.helicopter("consistent"), np.arange(N) * DT
    psi = 0.5
    outputs = {
        "x": 8.0 * np.cos(psi) * t, "y": 8.0 * np.sin(psi) * t, "dz": np.full(N, 0.1),
        "yaw": np.full(N, psi),
    }  # fmt: skip
    at = operating_point(model, xcell, STILL, outputs, DT)
    assert at.words == "the trim at 8 m/s ahead"
    assert float(at.state.dx) == pytest.approx(8.0 * np.cos(psi))
    assert float(at.state.dy) == pytest.approx(8.0 * np.sin(psi))
    rates = model.vector_field(xcell, at.state, at.inputs)
    for name in ("dx", "dy", "dz", "dphi", "dtheta", "dpsi", "Omega"):
        assert abs(float(getattr(rates, name))) < 1e-6


def test_a_linear_model_is_the_same_everywhere(bench30):
    s = {"x_roll": np.ones(N)}
    at = operating_point(models.roll_on_stand, bench30, s, {"roll": np.zeros(N)}, DT)
    assert at.state is None
    assert at.inputs is None
    assert at.words == ""


class Params(NamedTuple):
    drag: float


class State(NamedTuple):
    v: float


class Inputs(NamedTuple):
    force: float


class Outputs(NamedTuple):
    speed: float


sled = Model(
    "sled", lambda p, s, u: State(v=u.force - p.drag * s.v * jnp.abs(s.v)),
    lambda p, s, u: Outputs(speed=s.v), Params, State, Inputs, Outputs,
)  # fmt: skip


def test_own_models_are_linearised_at_the_records_mean():
    u = np.where(np.arange(N) % 50 < 25, 3.0, 5.0)
    drag, gain = 2.0, 2.0

    def rate(t, v):
        return gain * u[min(int(t / DT + 1e-9), N - 1)] - drag * v * abs(v)

    t = np.arange(N) * DT
    run = scipy.integrate.solve_ivp(rate, (0, t[-1]), [0.0], t_eval=t, max_step=DT / 4, rtol=1e-8)
    at = operating_point(sled, Params(drag), {"force": gain * u}, {"speed": run.y[0]}, DT)
    assert at.words == "the record's mean"
    assert float(at.inputs.force) == pytest.approx(gain * u.mean())
    assert float(at.state.v) == pytest.approx(run.y[0].mean(), rel=1e-3)
    H = continuous(sled, Params(drag), "speed", "force", at)
    pole = 2.0 * drag * run.y[0].mean()
    assert H(np.array([1.0]))[0] == pytest.approx(1.0 / (1j + pole), rel=1e-3)


def test_where_the_simulation_diverges_the_initial_state_serves():
    runaway = Model(
        "runaway", lambda p, s, u: State(v=u.force + p.drag * s.v**3), sled.output, Params, State,
        Inputs, Outputs, start=lambda p: State(v=0.1 * p.drag),
    )  # fmt: skip
    u = {"force": np.full(N, 3.0)}
    at = operating_point(runaway, Params(1.0), u, {"speed": np.zeros(N)}, DT)
    assert at.words == "the initial state and the record's mean inputs"
    assert float(at.state.v) == pytest.approx(0.1)
    assert float(at.inputs.force) == pytest.approx(3.0)


class Spin(NamedTuple):
    x: float
    y: float


class Throttle(NamedTuple):
    throttle: float


class Seen(NamedTuple):
    x: float


def test_a_fast_mode_that_is_there_in_flight_only_is_seen():
    # The throttle stiffens a spring: at zero throttle nothing moves.
    spring = Model(
        "spring",
        lambda p, s, u: Spin(x=s.y, y=-p.drag * s.y - 50.0**2 * u.throttle * s.x + u.throttle),
        lambda p, s, u: Seen(x=s.x), Params, Spin, Throttle, Seen,
    )  # fmt: skip
    t = np.arange(100) * 0.1
    flight = Flight(
        dt=0.1, inputs={"throttle": 1.0 + 0.1 * np.sign(np.sin(t))}, outputs={"x": np.sin(t)}
    )
    eigenvalues, _ = modes_of_flight(spring, Params(0.5), flight, 64)
    fast = 50.0 * np.sqrt(flight.inputs["throttle"].mean())
    assert np.imag(eigenvalues).max() == pytest.approx(fast, rel=1e-3)


def test_headings_on_either_side_of_south_are_one_heading(xcell):
    psi = np.where(np.arange(N) % 2, np.pi - 0.01, 0.01 - np.pi)
    outputs = {"dx": np.full(N, -8.0), "dy": np.zeros(N), "yaw": psi}
    at = operating_point(models.helicopter("consistent"), xcell, STILL, outputs, DT)
    assert at.words == "the trim at 8 m/s ahead"
