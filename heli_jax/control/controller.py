"""Controllers with memory, which act on a model at each sample.

`with_controller` returns the closed loop as a model. The controller's gains are parameters of that
model, so that they can be swept, fitted and differentiated like those of the vehicle. Sensors,
servos and delays of the model are within the loop.
"""

import abc
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import DictKey, SequenceKey

from heli_jax import naming
from heli_jax.analysis.trim import steady_flight
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Model, Sampled, require_continuous
from heli_jax.dynamics.onboard.delays import with_delay_line
from heli_jax.dynamics.onboard.device import Device, Parts, Quantity
from heli_jax.errors import nearest, require_known
from heli_jax.naming import Record

type Signals = Mapping[str, Any]
"""Scalars by name: traced or concrete numbers."""


class Controller(eqx.Module):
    """A control law in discrete time: `init`, and `step` at each sample.

    Scalars among the fields are gains, and become parameters of the closed loop; arrays are
    constants.
    """

    dt: eqx.AbstractVar[float]
    """Sample time [s]; a static field."""
    references: eqx.AbstractVar[tuple[str, ...]]
    """Signals with a set point; a static field."""

    @abc.abstractmethod
    def init(self) -> dict[str, Any]:
        """Return the controller's state at the first sample, scalars by name."""

    @abc.abstractmethod
    def step(
        self, state: dict[str, Any], measurement: Signals, reference: Signals
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the next state, and the command of each input.

        Args:
            measurement: the model's outputs by name, and states whose name is no output's.
            reference: set points by the name of their signal.
        """


COMMAND, SET, NOISE = "command_", "set_", "noise_"
STATE = GAIN = "controller_"
"""Prefixes of names in a closed loop: held commands, set points, sensor noise; the controller's
states and gains."""


def with_controller(model: Model, controller: Controller, noise: Iterable[str] = ()) -> Model:
    """Return the closed loop of a model and a controller.

    The controller acts at each sample of a simulation, and its command is held until the next. The
    command is added to the model's own inputs, which are the trim or an excitation. New inputs
    `set_SIGNAL` are set points, and `noise_SIGNAL` is added to what the controller reads. New
    parameters `controller_...` are the gains, with their values as defaults; the names follow the
    controller's fields. New states are `command_INPUT`, the held commands, and `controller_...`,
    the controller's own.

    Args:
        model: with its servos, sensors and delays; input delays become delay lines in the loop.
        noise: signals that the controller reads with noise.

    Raises:
        ValueError: a signal or an input that the model does not have, a state that is no scalar, or
            a model with a controller already.
    """
    check_model(model)
    if not isinstance(controller, Controller):
        raise TypeError(f"expected a Controller, got {type(controller).__name__}")
    require_continuous(model, "with_controller")
    words = f"model {model.name} has no signal"
    require_known(controller.references, signals_of(model), "references", words)
    require_known(noise := tuple(noise), signals_of(model), "noise", words)
    driven = commanded(model, controller)
    return _Controlled(in_loop(model, driven), controller, noise).closed()


def in_loop(model: Model, commands: Iterable[str]) -> Model:
    """Return the model with the delays of some inputs as delay lines.

    A feedback loop computes the input, so there is no record to read further back. A nonlinear
    model with delays must be trimmed with them.
    """
    for name in commands:
        if name in dict(model.delays):
            model = with_delay_line(model, name)
    return model


def signals_of(model: Model) -> tuple[str, ...]:
    """Return the names of the signals that a controller may read."""
    names = (*naming.names(model.State), *naming.names(model.Outputs))
    return tuple(dict.fromkeys(names))


def gains_of(controller: Controller) -> dict[str, Any]:
    """Return the gains of a controller by the names of their parameters."""
    leaves = jax.tree_util.tree_leaves_with_path(controller)
    return {_name(controller, path): leaf for path, leaf in leaves if np.shape(leaf) == ()}


def with_gains(controller: Controller, values: Signals) -> Any:
    """Return the controller with the gains among `values` (a mapping with their names)."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(controller)
    changed = [
        values[_name(controller, path)] if np.shape(leaf) == () else leaf for path, leaf in leaves
    ]
    return jax.tree.unflatten(structure, changed)


def measured(model: Model, params: Record, state: Record, inputs: Record) -> dict[str, Any]:
    """Return what a controller may read: outputs by name, and states whose name is no output's."""
    outputs = naming.asdict(model.output(params, state, inputs))
    return {**naming.asdict(state), **outputs}


def commands(model: Model, params: Record, run: Any) -> dict[str, Any]:
    """Return the commands (N,) of a closed loop's run by input, as held after each sample.

    Args:
        run: Trajectory of the closed loop `model`.
    """
    assert model.sampled is not None
    update = model.sampled.update
    after = jax.vmap(lambda s, u: update(params, s, u))(run.states, run.inputs)
    return {
        n.removeprefix(COMMAND): v for n, v in naming.asdict(after).items() if n.startswith(COMMAND)
    }


def begin(closed: Model, params: Record, trimmed: Any, samples: int) -> tuple[Record, Record]:
    """Return the closed loop's State, and its Inputs (samples,), that hold a steady flight.

    Args:
        params: the closed loop's Params.
        trimmed: a `Trim` of the model without controller, or a record with `state` and `inputs`.
    """
    assert closed.sampled is not None
    state, inputs = closed.sampled.hold(params, trimmed.state, trimmed.inputs)
    return state, jax.tree.map(lambda v: jnp.full(samples, v), inputs)


class _Controlled(Device):
    """A model with the held commands and the states of a controller."""

    def __init__(self, model: Model, controller: Controller, noise: tuple[str, ...]) -> None:
        self.driven = commanded(model, controller)
        units = {n: naming.unit(model.Inputs, n) for n in self.driven}
        states = {COMMAND + n: Quantity(units[n], f"command of {n}, held") for n in self.driven} | {
            STATE + n: Quantity(None, f"controller, {n}") for n in controller.init()
        }
        gains = {
            n: Quantity(None, f"gain of the controller, {n}", float(v))
            for n, v in gains_of(controller).items()
        }
        super().__init__(model, Parts(gains, states, linear=False))
        self.controller, self.noise = controller, noise
        known = {**naming.fields(model.State), **naming.fields(model.Outputs)}
        fields = {SET + n: (known[n], None) for n in controller.references}
        fields |= {NOISE + n: (known[n], None) for n in noise}
        given = model.Inputs
        self.Inputs = naming.extended(given, f"{given.__name__}Set", fields) if fields else given

    def closed(self) -> Model:
        return self.made(
            "controller",
            lambda bare: with_controller(bare, self.controller, self.noise),
            Inputs=self.Inputs,
            sampled=Sampled(self.controller.dt, self.update, self.model, self.hold),
            # Steady flight is that of the model: the controller acts on deviations from it.
            steady_flight=steady_flight(self.model),
            within=None,
        )

    def hold(self, p: Record, s: Record, u: Record) -> tuple[Record, Record]:
        """Return State and Inputs that hold a steady flight of the model."""
        state = self.State(**(naming.asdict(self.start(p)) | naming.asdict(s)))
        signals = measured(self.model, p, s, u)
        values = {SET + n: signals[n] for n in self.controller.references}
        values |= {NOISE + n: jnp.zeros_like(signals[n]) for n in self.noise}
        return state, self.Inputs(**{**values, **naming.asdict(u)})

    def inputs(self, p: Record, s: Record, u: Record) -> Record:
        """Return the model's inputs: the given ones, with the held commands added."""
        given = {n: getattr(u, n) for n in naming.names(self.model.Inputs)}
        given |= {n: given[n] + getattr(s, COMMAND + n) for n in self.driven}
        return self.model.Inputs(**given)

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return zeros: commands and the controller's states change at samples only."""
        zero = jnp.zeros_like(getattr(s, COMMAND + self.driven[0]))
        return dict.fromkeys(self.parts.states, zero)

    def first(self, p: Record) -> dict[str, Any]:
        own = with_gains(self.controller, naming.asdict(p)).init()
        return super().first(p) | {STATE + n: v for n, v in own.items()}

    def update(self, p: Record, s: Record, u: Record) -> Record:
        """Return the State after the controller's step at a sample."""
        # Sensors show what the command of the previous sample did.
        signals = measured(self.model, p, self.inner(s), self.inputs(p, s, u))
        signals |= {n: signals[n] + getattr(u, NOISE + n) for n in self.noise}
        controller = with_gains(self.controller, naming.asdict(p))
        own = {n: getattr(s, STATE + n) for n in controller.init()}
        references = {n: getattr(u, SET + n) for n in controller.references}
        own, command = controller.step(own, signals, references)
        changed = {COMMAND + n: v for n, v in command.items()}
        changed |= {STATE + n: v for n, v in own.items()}
        dtype = jnp.result_type(getattr(s, COMMAND + self.driven[0]))
        return naming.replace(s, **{n: jnp.asarray(v, dtype) for n, v in changed.items()})


def commanded(model: Model, controller: Controller) -> tuple[str, ...]:
    """Return the inputs that a controller commands in the model's order, without computing a step.

    Raises:
        ValueError: the controller reads an unknown signal, or commands an unknown input, or a state
            or command is no scalar.
    """
    names = dict.fromkeys(signals_of(model), 0.0)
    references = dict.fromkeys(controller.references, 0.0)
    own = controller.init()
    try:
        after, command = eqx.filter_eval_shape(controller.step, own, names, references)
    except KeyError as e:
        raise ValueError(
            f"model {model.name} has no signal {e.args[0]!r}{nearest(str(e.args[0]), names)}"
        ) from e
    if set(after) != set(own):
        raise ValueError(
            f"step: expected a state with {', '.join(own) or 'nothing'} as init returns, got "
            f"{', '.join(after) or 'nothing'}"
        )
    shapes = {n: jnp.shape(v) for n, v in {**after, **command}.items()}
    for name, shape in shapes.items():
        if shape != ():
            raise ValueError(f"step: expected scalars by name, got {name!r} of shape {shape}")
    if not command:
        raise ValueError("step: expected the command of at least one input, got none")
    require_known(command, naming.names(model.Inputs), "step", f"model {model.name} has no input")
    return tuple(n for n in naming.names(model.Inputs) if n in command)


def _name(controller: Controller, path: tuple[Any, ...]) -> str:
    """Return the name of a gain's parameter: its fields and keys, and the signals of loops."""
    parts, at = [], controller
    for key in path:
        if isinstance(key, SequenceKey):
            at = at[key.idx]  # pyright: ignore[reportIndexIssue]
            parts.append(str(getattr(at, "signal", key.idx)))
        elif isinstance(key, DictKey):
            at = at[key.key]  # pyright: ignore[reportIndexIssue]
            parts.append(str(key.key))
        else:
            at = getattr(at, key.name)
            parts.append(key.name)
    return GAIN + "_".join(parts)
