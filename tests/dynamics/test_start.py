"""Models that cannot start at zero: the message, and other initial states."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import yaml

from heli_jax import Flight, Free, Model, Problem
from heli_jax.cli import main
from heli_jax.dynamics.check_model import cannot_start, starting_at

N, DT = 120, 0.05


class Params(NamedTuple):
    La: float
    Md: float = 4.0


class State(NamedTuple):
    V: float
    alpha: float


class Inputs(NamedTuple):
    d: float


class Outputs(NamedTuple):
    alpha: float


def field(p, s, u):
    return State(V=0.0 * s.V, alpha=(p.Md * u.d - p.La * s.alpha) / s.V)


def output(p, s, u):
    return Outputs(alpha=s.alpha)


air = Model("air", field, output, Params, State, Inputs, Outputs)
D = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, N // 6), 6)


def by_scipy(La, V):
    found = [0.0]
    for d in D[:-1]:
        run = scipy.integrate.solve_ivp(
            lambda t, a, d=d: (4.0 * d - La * a) / V, (0, DT), [found[-1]], rtol=1e-9, atol=1e-12
        )
        found.append(float(run.y[0, -1]))
    return np.array(found)


def test_the_state_that_is_divided_by_is_named_with_the_remedies():
    assert "initial_state: {V: 1.0}" in cannot_start(air, Params(8.0))
    flight = Flight(dt=DT, inputs={"d": D}, outputs={"alpha": D})
    with pytest.raises(ValueError, match="V"):
        Problem(air, Params(8.0), [flight], {"La": Free(8.0)})
    assert cannot_start(starting_at(air, {"V": 5.0}), Params(8.0)) == ""


def test_a_root_at_zero_has_no_slope_there():
    root = Model(
        "root", lambda p, s, u: State(V=-jnp.sqrt(s.V), alpha=u.d), output,
        Params, State, Inputs, Outputs,
    )  # fmt: skip
    assert "slope of the rate of V" in cannot_start(root, Params(8.0))


def test_what_no_state_mends_is_said_without_a_state():
    broken = Model(
        "broken", lambda p, s, u: State(V=s.V / u.d, alpha=u.d), output,
        Params, State, Inputs, Outputs,
    )  # fmt: skip
    said = cannot_start(broken, Params(8.0), {"d": 0.0})
    assert said
    assert "initial_state" not in said


def test_an_unknown_state_is_refused():
    with pytest.raises(ValueError, match="speed"):
        starting_at(air, {"speed": 5.0})


@pytest.fixture
def config(tmp_path):
    alpha = by_scipy(8.0, 5.0) + 1e-3 * np.random.default_rng(1).standard_normal(N)
    rows = "\n".join(f"{k * DT:.6g},{d:.9g},{a:.9g}" for k, (d, a) in enumerate(zip(D, alpha)))  # noqa: B905
    (tmp_path / "log.csv").write_text(f"t,d,alpha\n{rows}\n")
    signals = {
        "time": {"signal": "t"}, "inputs": {"d": {"signal": "d"}},
        "outputs": {"alpha": {"signal": "alpha"}},
    }  # fmt: skip
    content = {
        "model": "tests.dynamics.test_start:air",
        "vehicle": {"La": 5.0, "Md": 4.0},
        "flights": [{"log": "log.csv", "signals": signals}],
        "fit": {"free": {"La": {"start": 5.0}}, "nuisance": {"initial_state": False}},
        "rls": None,
    }
    path = tmp_path / "air.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_configuration_says_where_to_begin(config, capsys):
    assert main(["check", str(config)]) == 2
    assert "initial_state: {V: 1.0}" in capsys.readouterr().err
    assert main(["check", str(config), "--set", "initial_state.v=5.0"]) == 2
    out = config.parent / "b"
    assert main(["fit", str(config), "--set", "initial_state.V=5.0", "--out", str(out)]) == 0
    # The run directory's configuration also starts there.
    assert yaml.safe_load((out / "config.yaml").read_text())["initial_state"] == {"V": 5.0}
    table = np.genfromtxt(out / "signals.csv", delimiter=",", names=True, dtype=None)
    wanted = by_scipy(8.0, 5.0)
    assert np.max(np.abs(table["alpha_simulated"] - wanted)) < 0.01 * np.max(np.abs(wanted))
