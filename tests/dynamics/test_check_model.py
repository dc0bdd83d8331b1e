"""Mistakes in a model of one's own end in a sentence that names the function and the remedy."""

import dataclasses
import math
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from heli_jax import Flight, Free, Model, Problem, linearize, simulate, sweep, trim
from heli_jax.cli import main
from heli_jax.dynamics import check_model as checks
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


class Other(NamedTuple):
    phi: float


def rates(p, s, u):
    return State(phi=s.p, p=p.Lp * s.p + p.La * u.aileron)


def measured(p, s, u):
    return Outputs(roll_rate=s.p)


def beginning(p):
    return State(phi=0.0 * p.Lp, p=0.1 * p.La)


def numpy_function(p, s, u):
    return State(phi=s.p, p=p.Lp * np.sin(s.p) + p.La * u.aileron)


def of_math(p, s, u):
    return State(phi=s.p, p=p.Lp * math.sin(s.p))


def branch(p, s, u):
    return State(phi=s.p, p=p.Lp * s.p if s.p > 0 else -p.Lp)


def raising(p, s, u):
    raise RuntimeError("the table has no such entry")


def of_two(p, s):
    return State(phi=s.p, p=s.p)


BROKEN = {
    "NumPy": ({"vector_field": numpy_function}, ["vector_field", "numpy_function", "jnp.sin"]),
    "math": ({"vector_field": of_math}, ["of_math", "math.sin", "jnp.sin"]),
    "a branch": ({"vector_field": branch}, ["branch", "jnp.where", "jax.lax.cond"]),
    "its own exception": (
        {"vector_field": raising}, ["raising", "RuntimeError", "the table has no such entry"],
    ),
    "two arguments": ({"vector_field": of_two}, ["of_two", "TypeError", "positional"]),
    "a tuple": (
        {"vector_field": lambda p, s, u: (s.p, p.Lp * s.p)},
        ["vector_field", "return State(phi=..., p=...)", "got a tuple of 2"],
    ),
    "a dictionary": (
        {"vector_field": lambda p, s, u: {"phi": s.p, "p": s.p}},
        ["return State(phi=..., p=...)", "got a dict"],
    ),
    "nothing": (
        {"vector_field": lambda p, s, u: None},
        ["return State(phi=..., p=...)", "got None"],
    ),
    "another class": (
        {"vector_field": lambda p, s, u: Other(phi=s.p)}, ["State", "an object of class Other"],
    ),
    "a missing field": (
        {"vector_field": lambda p, s, u: State(phi=s.p)}, ["vector_field", "TypeError", "'p'"],
    ),
    "an unknown field": ({"vector_field": lambda p, s, u: s.roll}, ["AttributeError", "roll"]),
    "an array in a field": (
        {"vector_field": lambda p, s, u: State(phi=s.p, p=jnp.ones(3) * s.p)},
        ["one number for 'p'", "(3,)", "jax.vmap"],
    ),
    "None in a field": (
        {"vector_field": lambda p, s, u: State(phi=s.p, p=None)}, ["'p'", "got None"],
    ),
    "text in a field": (
        {"vector_field": lambda p, s, u: State(phi=s.p, p="fast")}, ["'p'", "got a str"],
    ),
    "a complex number": (
        {"vector_field": lambda p, s, u: State(phi=s.p, p=jax.lax.complex(s.p, s.p))},
        ["'p'", "complex"],
    ),
    "no function": ({"vector_field": 3}, ["a function of (params, state, inputs)", "got a int"]),
    "output with NumPy": (
        {"output": lambda p, s, u: Outputs(roll_rate=np.cos(s.p))}, ["output", "jnp.sin"],
    ),
    "output with a tuple": (
        {"output": lambda p, s, u: (s.p,)}, ["output", "return Outputs(roll_rate=...)"],
    ),
    "output with a dictionary": (
        {"output": lambda p, s, u: {"roll_rate": s.p}}, ["Outputs", "got a dict"],
    ),
    "output with an array": (
        {"output": lambda p, s, u: Outputs(jnp.stack([s.p, s.p]))}, ["'roll_rate'", "(2,)"],
    ),
    "start with a branch": (
        {"start": lambda p: State(0.0, 1.0 if p.Lp > 0 else 2.0)}, ["start", "jnp.where"],
    ),
    "start with a list": ({"start": lambda p: [0.0, 0.0]}, ["start", "State", "a list of 2"]),
    "noise without a state": ({"noise_intensity": lambda p: p.Lp}, ["noise_intensity", "State"]),
    "sd of a stranger": ({"initial_sd": lambda p: {"q": p.Lp}}, ["initial_sd", "'q'", "phi, p"]),
    "limits that are none": ({"limits": lambda p, s, u: s.p > 1.0}, ["limits", "dictionary"]),
    "parameters that are no class": ({"Params": {"Lp": 1.0}}, ["Params", "NamedTuple", "a dict"]),
    "a delay of a stranger": ({"delays": (("ail", "Lp"),)}, ["delays", "'ail'", "'aileron'?"]),
    "a delay by a stranger": (
        {"delays": (("aileron", "tau"),)}, ["delays of aileron: no parameter 'tau'", "La, Lp"],
    ),
    "delays in a dictionary": ({"delays": {"aileron": "Lp"}}, ["a tuple", "got {'aileron'"]),
    "delays that are no pairs": ({"delays": ("aileron", "Lp")}, ["pairs", "got 'aileron'"]),
    "two delays": ({"delays": (("aileron", "Lp"), ("aileron", "La"))}, ["one delay", "two"]),
    "a delay in metres": (
        {"Params": Timed, "delays": (("aileron", "La"),)}, ["delays of aileron", "got 'm'"],
    ),
    "an axis of no state": ({"axes": (Axis("roll", rate="q"),)}, ["roll.rate: no state 'q'"]),
    "an axis of no stick": (
        {"axes": (Axis("roll", rate="p", stick="lat"),)}, ["roll.stick: no input 'lat'"],
    ),
    "an axis alone": ({"axes": Axis("roll", rate="p")}, ["axes", "a tuple"]),
    "axes by name": ({"axes": ("p",)}, ["axes", "an Axis", "got 'p'"]),
    "positive strangers": ({"positive": ("Lq",)}, ["positive", "'Lq'"]),
    "parameters in a plain dataclass": (
        {"Params": Plain}, ["Params", "got Plain", "@jax.tree_util.register_dataclass"],
    ),
    "states that are an object": ({"State": State(0.0, 0.0)}, ["State", "NamedTuple"]),
}  # fmt: skip


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
    changed, words = BROKEN[case]
    said = said_by(check_model, made(**changed))
    assert said.startswith("model 'mine': ")
    for word in words:
        assert word in said, said


@pytest.mark.parametrize("case", ["NumPy", "a branch", "a tuple", "output with a dictionary"])
def test_every_way_in_says_it(case):
    changed, words = BROKEN[case]
    model, params = made(**changed), Params(-3.0, 20.0)
    traced = Params(jnp.asarray(-3.0), jnp.asarray(20.0))
    ways = {
        "Problem": lambda: Problem(model, params, [flight()], {"Lp": Free(-2.0)}),
        "simulate": lambda: simulate(model, params, flight()),
        "simulate, compiled": lambda: jax.jit(lambda p: simulate(model, p, flight()))(traced),
        "linearize": lambda: linearize(model, params),
        "trim": lambda: trim(model, params),
        "sweep": lambda: sweep(
            model, params, flight(), sobol({"Lp": Range(-4.0, -2.0)}, 4),
            {"peak": Reduce("max", "roll_rate")},
        ),
        "on_stand": lambda: on_stand(model),
    }  # fmt: skip
    for way, call in ways.items():
        said = said_by(call)
        assert all(word in said for word in words), (way, said)


@pytest.mark.parametrize(
    ("value", "got"),
    [
        (None, "None"),
        ("roll", "the name 'roll'"),
        (Model, "the class Model"),
        (rates, "a function"),
        (
            helicopter,
            "the function helicopter, which makes one; expected what it returns, as helicopter()",
        ),
    ],
)
def test_what_is_no_model(value, got):
    ways = [
        lambda: Problem(value, Params(-3.0, 20.0), [flight()], {"Lp": Free(-2.0)}),
        lambda: simulate(value, Params(-3.0, 20.0), flight()),
        lambda: trim(value, Params(-3.0, 20.0)),
        lambda: sweep(value, Params(-3.0, 20.0), flight(), sobol({"Lp": Range(1, 2)}, 4), {}),
    ]
    for call in ways:
        said = said_by(call, error=TypeError)
        assert said.startswith("model: expected a heli_jax.Model")
        assert said.endswith(f"got {got}")


def test_sound_models_pass():
    class Elsewhere(NamedTuple):  # the same fields by another class: for outputs that will do
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
    assert "jnp.where" in said_by(Problem, model, Params(-3.0, 1.0), [flight()], {"Lp": Free(-2.0)})


def test_a_model_is_looked_at_once(monkeypatch):
    looked = []
    monkeypatch.setattr(checks, "_check", lambda *a: looked.append(a))
    model = made(vector_field=lambda p, s, u: rates(p, s, u))
    for _ in range(5):
        check_model(model)
    assert len(looked) == 1


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
    ("name", "parts", "words"),
    [
        ("by_numpy", {"rates": "return State(p=np.sin(s.p))"}, ["by_numpy.rates", "jnp.sin"]),
        ("by_dict", {"rates": "return {'p': s.p}"}, ["by_dict.rates", "return State(p=...)"]),
        ("by_zero", {"last": "1 / 0"}, ["cannot import 'by_zero'", "line 17", "ZeroDivisionError"]),
        ("by_exit", {"last": "raise SystemExit(0)"}, ["cannot import 'by_exit'", "SystemExit"]),
    ],
)
def test_the_command_line_ends_in_a_sentence(tmp_path, capsys, name, parts, words):
    text = MODULE.format(**{"rates": "return State(p=params.Lp * s.p)", "last": "", **parts})
    (tmp_path / f"{name}.py").write_text(text)
    config = tmp_path / "c.yaml"
    config.write_text(yaml.safe_dump({"model": f"{name}:model", "vehicle": {"Lp": -3.0}}))
    for command in ("fit", "check", "simulate", "sweep"):
        assert main([command, str(config)]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert len(err.splitlines()) == 1
        for word in ("c.yaml: model:", *words):
            assert word in err
