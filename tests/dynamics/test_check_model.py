"""Mistakes in a user's model: the message names the function and the remedy."""

import dataclasses
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from heli_jax import Flight, Free, Model, Problem, linearize, simulate, sweep, trim
from heli_jax.cli import main
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Axis
from heli_jax.models import helicopter, on_stand
from heli_jax.sweeps import Range, Reduce, sobol


class Params(NamedTuple):
    Lp: float
    La: float


class Timed(NamedTuple):
    Lp: Annotated[float, "s"]
    La: Annotated[float, "m"]


@dataclasses.dataclass
class Plain:
    Lp: float
    La: float


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Registered(Plain):
    pass


class State(NamedTuple):
    phi: float
    p: float


class Inputs(NamedTuple):
    aileron: float


class Outputs(NamedTuple):
    roll_rate: float


def rates(p, s, u):
    return State(phi=s.p, p=p.Lp * s.p + p.La * u.aileron)


def measured(p, s, u):
    return Outputs(roll_rate=s.p)


def beginning(p):
    return State(phi=0.0 * p.Lp, p=0.1 * p.La)


def numpy_function(p, s, u):
    return State(phi=s.p, p=p.Lp * np.sin(s.p) + p.La * u.aileron)


def branch(p, s, u):
    return State(phi=s.p, p=p.Lp * s.p if s.p > 0 else -p.Lp)


def raising(p, s, u):
    raise RuntimeError("the table has no such entry")


BROKEN = {
    "NumPy": {"vector_field": numpy_function},
    "a branch": {"vector_field": branch},
    "its own exception": {"vector_field": raising},
    "a tuple": {"vector_field": lambda p, s, u: (s.p, p.Lp * s.p)},
    "nothing": {"vector_field": lambda p, s, u: None},
    "a missing field": {"vector_field": lambda p, s, u: State(phi=s.p)},
    "an array in a field": {"vector_field": lambda p, s, u: State(phi=s.p, p=jnp.ones(3) * s.p)},
    "text in a field": {"vector_field": lambda p, s, u: State(phi=s.p, p="fast")},
    "a complex number": {
        "vector_field": lambda p, s, u: State(phi=s.p, p=jax.lax.complex(s.p, s.p))
    },
    "no function": {"vector_field": 3},
    "output with a tuple": {"output": lambda p, s, u: (s.p,)},
    "start with a branch": {"start": lambda p: State(0.0, 1.0 if p.Lp > 0 else 2.0)},
    "noise without a state": {"noise_intensity": lambda p: p.Lp},
    "sd of a stranger": {"initial_sd": lambda p: {"q": p.Lp}},
    "limits that are none": {"limits": lambda p, s, u: s.p > 1.0},
    "parameters that are no class": {"Params": {"Lp": 1.0}},
    "a delay of a stranger": {"delays": (("ail", "Lp"),)},
    "a delay by a stranger": {"delays": (("aileron", "tau"),)},
    "delays that are no pairs": {"delays": ("aileron", "Lp")},
    "two delays": {"delays": (("aileron", "Lp"), ("aileron", "La"))},
    "a delay in metres": {"Params": Timed, "delays": (("aileron", "La"),)},
    "an axis of no state": {"axes": (Axis("roll", rate="q"),)},
    "an axis of no stick": {"axes": (Axis("roll", rate="p", stick="lat"),)},
    "an axis alone": {"axes": Axis("roll", rate="p")},
    "positive strangers": {"positive": ("Lq",)},
    "parameters in a plain dataclass": {"Params": Plain},
    "states that are an object": {"State": State(0.0, 0.0)},
}


def made(**changed):
    parts = {
        "name": "mine", "vector_field": rates, "output": measured, "Params": Params,
        "State": State, "Inputs": Inputs, "Outputs": Outputs,
    }  # fmt: skip
    model = Model(**parts)
    for name, value in changed.items():  # the tests' checked annotations would refuse some
        object.__setattr__(model, name, value)
    return model


def flight():
    t = np.arange(60) * 0.05
    u = np.sign(np.sin(3.0 * t))
    return Flight(dt=0.05, inputs={"aileron": u}, outputs={"roll_rate": np.cos(t)})


def said_by(function, *arguments, error: type[Exception] = ValueError, **how):
    with pytest.raises(error) as e:
        function(*arguments, **how)
    assert type(e.value) is error
    assert "\n" not in str(e.value)
    return str(e.value)


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_model_is_refused_with_a_sentence(case):
    said = said_by(check_model, made(**BROKEN[case]))
    assert said.startswith("model 'mine': ")
    # The message names the fault.
    assert list(BROKEN[case])[-1] in said


def test_every_way_in_says_it():
    model, params = made(vector_field=branch), Params(-3.0, 20.0)
    traced = Params(jnp.asarray(-3.0), jnp.asarray(20.0))
    ways = [
        lambda: Problem(model, params, [flight()], {"Lp": Free(-2.0)}),
        lambda: jax.jit(lambda p: simulate(model, p, flight()))(traced),
        lambda: linearize(model, params),
        lambda: trim(model, params),
        lambda: sweep(
            model, params, flight(), sobol({"Lp": Range(-4.0, -2.0)}, 4),
            {"peak": Reduce("max", "roll_rate")},
        ),
        lambda: on_stand(model),
    ]  # fmt: skip
    assert len({said_by(call) for call in ways}) == 1


@pytest.mark.parametrize("value", [None, "roll", Model, rates, helicopter])
def test_what_is_no_model(value):
    ways = [
        lambda: Problem(value, Params(-3.0, 20.0), [flight()], {"Lp": Free(-2.0)}),
        lambda: simulate(value, Params(-3.0, 20.0), flight()),
        lambda: trim(value, Params(-3.0, 20.0)),
        lambda: sweep(value, Params(-3.0, 20.0), flight(), sobol({"Lp": Range(1, 2)}, 4), {}),
    ]
    assert len({said_by(call, error=TypeError) for call in ways}) == 1


def test_sound_models_pass():
    class Elsewhere(NamedTuple):  # another class with the same fields, which is enough for outputs
        roll_rate: float

    check_model(made(start=beginning, noise_intensity=lambda p: State(0.0, p.La)))
    check_model(made(vector_field=lambda p, s, u: State(phi=0.0, p=1)))
    check_model(made(output=lambda p, s, u: Elsewhere(s.p)))
    check_model(made(limits=lambda p, s, u: {"fast": s.p > 1.0}, initial_sd=lambda p: {"p": p.La}))
    axis = Axis("roll", rate="p", angle="phi", inertia="Lp", stick="aileron")
    check_model(made(Params=Timed, delays=(("aileron", "Lp"),), axes=(axis,), positive=("La",)))
    with jax.numpy_dtype_promotion("strict"):
        check_model(made(output=lambda p, s, u: Outputs(2 * s.p)))


def test_a_registered_dataclass_serves_as_parameters():
    run = simulate(made(Params=Registered), Registered(-3.0, 20.0), flight())
    same = simulate(made(), Params(-3.0, 20.0), flight())
    np.testing.assert_array_equal(run.outputs.roll_rate, same.outputs.roll_rate)


def test_parameters_that_stay_numbers_may_be_branched_on_in_a_simulation():
    def switched(p, s, u):
        return State(phi=s.p, p=p.Lp * s.p if p.Lp < 0 else 0.0 * s.p)

    model = made(vector_field=switched)
    found = simulate(model, Params(-3.0, 20.0), flight())
    assert bool(found.finite)
    assert said_by(Problem, model, Params(-3.0, 1.0), [flight()], {"Lp": Free(-2.0)})


MODULE = """
from typing import NamedTuple
import numpy as np
from heli_jax import Model
class Params(NamedTuple):
    Lp: float
class State(NamedTuple):
    p: float
class Inputs(NamedTuple):
    aileron: float
class Outputs(NamedTuple):
    roll_rate: float
def rates(params, s, u):
    {rates}
def measured(params, s, u):
    return Outputs(roll_rate=s.p)
{last}
model = Model("mine", rates, measured, Params, State, Inputs, Outputs)
"""


@pytest.mark.parametrize(
    "parts",
    [
        {"rates": "return State(p=np.sin(s.p))"},
        {"last": "1 / 0"},
        {"last": "raise SystemExit(0)"},
    ],
)
def test_the_command_line_ends_in_a_sentence(tmp_path, capsys, parts):
    text = MODULE.format(**{"rates": "return State(p=params.Lp * s.p)", "last": "", **parts})
    name = f"own_{len(text)}"
    (tmp_path / f"{name}.py").write_text(text)
    config = tmp_path / "c.yaml"
    config.write_text(yaml.safe_dump({"model": f"{name}:model", "vehicle": {"Lp": -3.0}}))
    for command in ("check", "sweep"):
        assert main([command, str(config)]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert len(err.splitlines()) == 1
        assert "c.yaml: model:" in err
        assert name in err
