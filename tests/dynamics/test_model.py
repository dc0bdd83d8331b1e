"""A user's model, its linearisation, and the names of models."""

import dataclasses
import importlib.machinery
import sys
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from heli_jax import Model, import_path, models, simulate
from heli_jax.analysis.linear import eigenmodes
from heli_jax.analysis.trim import steady_flight
from heli_jax.dynamics.disturbance import disturbable, with_disturbance
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Axis, axes_of, linear_misfit
from heli_jax.errors import InputError


class Params(NamedTuple):
    Lp: float
    Lda: float
    drag: float = 0.0
    start: float = 0.0


class State(NamedTuple):
    phi: float
    p: float


class Inputs(NamedTuple):
    aileron: float


class Outputs(NamedTuple):
    roll_rate: float


def field(params, s, u):
    drag = params.drag * jnp.abs(s.p) * s.p
    return State(phi=s.p, p=params.Lp * s.p - drag + params.Lda * u.aileron)


def output(params, s, u):
    return Outputs(roll_rate=s.p + 0.5 * u.aileron)


own = Model(
    "own", field, output, Params, State, Inputs, Outputs,
    start=lambda p: State(phi=0.0 * p.start, p=p.start),
)  # fmt: skip
own_linear = Model("own", field, output, Params, State, Inputs, Outputs, linear=True)

U, DT = np.random.default_rng(0).uniform(-1.0, 1.0, 40), 0.05


def by_scipy(params, start):
    states = [np.array([0.0, start])]
    for u in U[:-1]:

        def rates(t, x, u=u):
            return [x[1], params.Lp * x[1] - params.drag * abs(x[1]) * x[1] + params.Lda * u]

        one = scipy.integrate.solve_ivp(rates, (0, DT), states[-1], rtol=1e-11, atol=1e-13)
        states.append(one.y[:, -1])
    return np.array(states)


def test_own_nonlinear_model_against_scipy():
    params = Params(Lp=-3.0, Lda=20.0, drag=0.4, start=1.0)
    found = simulate(own, params, Inputs(U), dt=DT, substeps=16)
    wanted = by_scipy(params, 1.0)
    np.testing.assert_allclose(found.states.phi, wanted[:, 0], atol=1e-6)
    np.testing.assert_allclose(found.states.p, wanted[:, 1], atol=1e-6)
    np.testing.assert_allclose(found.outputs.roll_rate, wanted[:, 1] + 0.5 * U, atol=1e-6)
    assert bool(found.finite)


def test_own_linear_model_is_exact():
    params = Params(Lp=-3.0, Lda=20.0)
    found = simulate(own_linear, params, Inputs(U), dt=DT)
    decay, p = np.exp(-3.0 * DT), [0.0]
    for u in U[:-1]:
        p.append(decay * p[-1] + 20.0 * u * (1.0 - decay) / 3.0)
    np.testing.assert_allclose(found.states.p, p, rtol=1e-12, atol=1e-13)


def test_jacobians_at_a_point_against_finite_differences():
    params, x, u, h = Params(Lp=-3.0, Lda=20.0, drag=0.4), np.array([0.2, 1.5]), 0.3, 1e-6

    def f(x, u):
        return np.array([x[1], params.Lp * x[1] - params.drag * abs(x[1]) * x[1] + params.Lda * u])

    A, B, C, D = jacobians(own, params, State(*x), Inputs(u))
    for k, e in enumerate(np.eye(2) * h):
        np.testing.assert_allclose(A[:, k], (f(x + e, u) - f(x - e, u)) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(B[:, 0], (f(x, u + h) - f(x, u - h)) / (2 * h), atol=1e-7)
    np.testing.assert_array_equal(C, [[0.0, 1.0]])
    np.testing.assert_array_equal(D, [[0.5]])


def test_linear_misfit(bench30):
    assert linear_misfit(models.roll_on_stand, bench30) < 1e-12
    assert linear_misfit(own, Params(Lp=-3.0, Lda=20.0)) < 1e-12
    assert linear_misfit(own, Params(Lp=-3.0, Lda=20.0, drag=1.0)) > 1e-3
    shifted = Model(
        "shifted", lambda p, s, u: State(s.p, 1.0 + s.p), output, Params, State, Inputs, Outputs
    )
    assert linear_misfit(shifted, Params(Lp=-3.0, Lda=20.0)) > 1e-3


def test_own_model_by_import_path(tmp_path):
    assert models.by_name("tests.dynamics.test_model:own") is own
    (tmp_path / "beside_the_configuration.py").write_text(
        "from tests.dynamics.test_model import own as mine\n"
    )
    found = models.by_name("beside_the_configuration:mine", folder=tmp_path)
    assert found.name == "own"
    # A file beside a configuration never replaces an installed module.
    (tmp_path / "llvmlite.py").write_text("raise SystemExit('ran')\n")
    import llvmlite

    assert Path(llvmlite.__file__).parent != tmp_path
    assert importlib.machinery.PathFinder.find_spec("llvmlite").origin == llvmlite.__file__
    assert import_path.searched()[-1] == sys.path[-1] == str(tmp_path)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("rol", "'roll'"),
        ("roll-flybarless", "'{linear: roll-flybarless}'"),
        ("mine.yaml", "'{linear: mine.yaml}'"),
        ("", ""),
        ("no_such_module:model", ""),
        ("tests.dynamics.test_model:nothing", ""),
        ("tests.dynamics.test_model:U", ""),
        ("heli_jax.models:helicopter", ""),
        ("os:system('ls')", ""),
    ],
)
def test_what_is_no_model(name, meant):
    with pytest.raises(InputError, match=f"^f.yaml: model: .*{meant}"):
        models.by_name(name, "f.yaml: model")


class TurnState(NamedTuple):
    angle: float
    p: float


class TurnParams(NamedTuple):
    J: float
    J_added: float
    kappa: float = 3.0
    zeta: float = 0.5


def turning(**changes):
    """Return a vehicle on one axis with its own names."""
    return Model(
        "turn",
        lambda p, s, u: TurnState(s.p, u.x_roll / (p.J + p.J_added)),
        lambda p, s, u: models.roll.Outputs(s.angle, s.p),
        TurnParams, TurnState, models.roll.Inputs, models.roll.Outputs, linear=True, **changes,
    )  # fmt: skip


def test_a_model_that_states_its_axes_is_disturbed_and_put_on_a_stand():
    axis = Axis("bank", "p", "angle", "J", "J_added", "x_roll")
    model = turning(axes=(axis,))
    assert disturbable(model) == ["bank"]
    assert disturbable(turning()) == []
    assert disturbable(with_disturbance(model, "bank")) == ["bank"]
    stand = models.on_stand(model)
    x, u = TurnState(0.1, 0.2), models.roll.Inputs(0.0)
    rates = stand.vector_field(TurnParams(2.0, 2.0), x, u)
    assert rates.p == pytest.approx(-0.5 * (3.0 * 0.1 + 0.5 * 0.2))
    shares = eigenmodes(stand, TurnParams(2.0, 2.0, zeta=0.1))
    assert [mode.name for mode in shares] == ["bank"]


@pytest.mark.parametrize("variant", ["paper", "consistent", "full"])
@pytest.mark.parametrize(
    "more", [{}, {"dynamic_inflow": True}, {"first_order_bar": True}, {"flybarless": True}]
)
def test_what_the_helicopter_states_is_what_its_names_say(variant, more):
    model = models.helicopter(variant, wind=True, **more)
    silent = dataclasses.replace(model, axes=None, steady_flight=None)
    assert axes_of(silent) == axes_of(model)
    assert steady_flight(silent) == steady_flight(model)
    assert len(model.steady_flight.unknowns) == len(model.steady_flight.equations)
