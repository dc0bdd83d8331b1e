"""Pure delays of inputs and outputs, as model parameters."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Model, zeros
from heli_jax.dynamics.onboard.device import Device, Parts, Quantity, require
from heli_jax.naming import Record

ORDER = 4
"""Default number of states of a delay line: error 2e-4 at 2/delay rad/s, 3 % at 4/delay."""
_HIGHEST = 8

type Late = Sequence[str] | Mapping[str, str]
"""Names (the parameter is then `delay_NAME`), or a mapping of names to delay parameters."""


def with_delays(
    model: Model, inputs: Late = (), outputs: Late = (), *, order: int = ORDER
) -> Model:
    """Return the model with pure delays on inputs and outputs, each with a parameter [s].

    An input delay is exact (`Model.delays`). It may be negative, for a stick that is logged late.
    An output delay is a delay line of `order` states, `OUTPUT_late0` and so on. The line is the
    Pade approximation [order - 1/order] of exp(-s delay), with Legendre coefficients of the
    output's past as states (Voelker, Kajic and Eliasmith, 2019). It is linear and differentiable,
    so matrices, modes, filters and windows include it.

    Args:
        inputs: names, or a mapping to parameters. Several inputs may share a parameter.
        order: states of each output's delay line, 1 to 8.

    Raises:
        ValueError: no such input or output, one that has a delay already, or a name that is taken.
    """
    check_model(model)
    if not (isinstance(order, int) and 1 <= order <= _HIGHEST):
        raise ValueError(f"order: expected 1 to {_HIGHEST} states, got {order!r:.20}")
    # An input is a record, which can be read exactly at any other time. An output is computed, so
    # its past must be kept in states.
    late_in, late_out = _by_name(inputs), _by_name(outputs)
    if not late_in and not late_out:
        raise ValueError("expected an input or an output to delay, got none")
    if late_in:
        require(late_in, model.Inputs, "input", model)
        model = with_input_delays(model, late_in)
    return _with_output_delays(model, tuple(late_out.items()), order) if late_out else model


def _by_name(late: Late) -> dict[str, str]:
    if isinstance(late, Mapping):
        return {str(n): str(p) for n, p in late.items()}
    twice = [n for i, n in enumerate(late) if n in late[:i]]
    if twice:
        raise ValueError(f"{twice[0]!r} is named twice, expected it once")
    return {n: f"delay_{n}" for n in late}


def with_input_delays(model: Model, parameters: Mapping[str, str]) -> Model:
    """Return the model with input delays that are new parameters.

    Raises:
        ValueError: an input has a delay already, or the model has a parameter of that name.
    """
    return _with_input_delays(model, tuple(parameters.items()))


@functools.cache
def _with_input_delays(model: Model, parameters: tuple[tuple[str, str], ...]) -> Model:
    on_time(model, (n for n, _ in parameters))
    new: dict[str, list[str]] = {}
    for name, parameter in parameters:
        # Several inputs may share one parameter, for example all sticks that go through one radio.
        new.setdefault(parameter, []).append(name)
    fields = {}
    for parameter, names in new.items():
        if parameter in naming.names(model.Params):
            raise ValueError(
                f"model {model.name} has a parameter {parameter!r} already, expected another name"
            )
        # A delay has no default: NaN makes the user give one. It may be negative, for a stick that
        # is logged late, so it is not marked positive as output delays are.
        quantity = Quantity("s", f"delay of {', '.join(names)}", math.nan)
        fields[parameter] = (quantity.annotation, math.nan)
    return dataclasses.replace(
        model,
        name=f"{model.name}+delays",
        Params=naming.extended(model.Params, f"{model.Params.__name__}Late", fields),
        delays=(*model.delays, *parameters),
    )


def on_time(model: Model, names: Iterable[str]) -> None:
    """Raise if an input has a delay already.

    Raises:
        ValueError: with the input and its delay.
    """
    late = dict(model.delays)
    for name in names:
        if name in late:
            raise ValueError(
                f"input {name!r} of model {model.name} has the delay {late[name]} already, "
                "expected one delay"
            )


@functools.cache
def _with_output_delays(model: Model, late: tuple[tuple[str, str], ...], order: int) -> Model:
    require((n for n, _ in late), model.Outputs, "output", model)
    for _, parameter in late:
        if parameter in naming.names(model.Params):
            raise ValueError(
                f"model {model.name} has a parameter {parameter!r} already, expected another name"
            )
    # Delays are also kept by name in `delay_lines`: a fit with a free delay uses several starts.
    device = _LateOutputs(model, dict(late), order)
    return device.made(
        "output-delays",
        lambda bare: _with_output_delays(bare, late, order),
        delay_lines=(*model.delay_lines, *late),
    )


class _LateOutputs(Device):
    """Delay lines on some outputs."""

    def __init__(self, model: Model, late: dict[str, str], order: int) -> None:
        params = {
            parameter: Quantity("s", f"delay of {name} in the log", math.nan, True)
            for name, parameter in late.items()
        }
        # The states are the output's past, so they have its unit. A line's delay must be positive:
        # it stores the past and cannot look ahead.
        units = {n: naming.unit(model.Outputs, n) for n in late}
        states = {
            state: Quantity(units[n], f"past of {n}, Legendre coefficient {i}")
            for n in late
            for i, state in enumerate(line_states(n, order))
        }
        super().__init__(model, Parts(params, states))
        self.late, self.order = late, order

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the time derivatives of the delay lines' states."""
        measured = self.measured(p, s, u)
        rates = {}
        for n, parameter in self.late.items():
            line = line_states(n, self.order)
            past = [getattr(s, state) for state in line]
            changes = line_rates(past, getattr(measured, n), getattr(p, parameter))
            rates |= dict(zip(line, changes, strict=True))
        return rates

    def shown(self, p: Record, s: Record, u: Record, y: Record) -> Record:
        """Return the outputs, with delayed ones read from their delay lines."""
        return naming.replace(
            y,
            **{
                n: line_value(
                    [getattr(s, state) for state in line_states(n, self.order)],
                    getattr(y, n),
                    getattr(p, parameter),
                )
                for n, parameter in self.late.items()
            },
        )

    def first(self, p: Record) -> dict[str, Any]:
        # Fill the line as if the output had always had its first value: coefficient 0 is the mean.
        # Zero states would show a step from zero to the first output, which no flight has.
        at_first = self.model.output(p, self.model.initial_state(p), zeros(self.model.Inputs))
        first = super().first(p)
        return first | {line_states(n, 1)[0]: getattr(at_first, n) for n in self.late}


@functools.cache
def with_delay_line(model: Model, name: str, order: int = ORDER) -> Model:
    """Return the model with one input's delay as a delay line.

    A feedback loop computes the input, so there is no record to read further back.
    """
    device = _LateInput(model, name, dict(model.delays)[name], order)
    # Without this the delay would act twice: on the record and in the line.
    rest = tuple((n, parameter) for n, parameter in model.delays if n != name)
    return device.made(
        "delay-line",
        lambda bare: with_delay_line(bare, name, order),
        delays=rest,
        # A log can be read ahead for a stick that is logged late. A delay line only has the past.
        positive=(*model.positive, device.parameter),
        delay_lines=(*model.delay_lines, (name, device.parameter)),
    )


class _LateInput(Device):
    """Delay line on one input, whose delay is a parameter of the model already."""

    def __init__(self, model: Model, name: str, parameter: str, order: int) -> None:
        unit = naming.unit(model.Inputs, name)
        states = {
            state: Quantity(unit, f"past of {name}, Legendre coefficient {i}")
            for i, state in enumerate(line_states(name, order))
        }
        super().__init__(model, Parts({}, states))
        self.name, self.parameter = name, parameter

    def inputs(self, p: Record, s: Record, u: Record) -> Record:
        """Return the inputs, with the delayed one read from its line."""
        past = [getattr(s, n) for n in self.parts.states]
        late = line_value(past, getattr(u, self.name), getattr(p, self.parameter))
        return naming.replace(u, **{self.name: late})

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the time derivatives of the line's states."""
        past = [getattr(s, n) for n in self.parts.states]
        changes = line_rates(past, getattr(u, self.name), getattr(p, self.parameter))
        return dict(zip(self.parts.states, changes, strict=True))


def line_states(name: str, order: int) -> tuple[str, ...]:
    """Return the names of a delay line's states."""
    return tuple(f"{name}_late{i}" for i in range(order))


def line_value(past: Sequence[Any], value: Any, delay: Any) -> Any:
    """Return the output of a delay line, or the current value if the delay is zero.

    Args:
        delay: [s].
    """
    return jnp.where(delay == 0, value, line_end(past))


def line_end(past: Sequence[Any]) -> Any:
    """Return the signal one delay ago, from the one or more states of a delay line."""
    # All shifted Legendre polynomials are 1 at the far end, so the value is the sum of
    # coefficients.
    return sum(past)


_UNREAD = 0.02
"""Substitute for a zero delay, whose line is not read; slow enough for solver steps [s]."""


def _possible(delay: Any) -> Any:
    """Return the delay by which a line's rates are divided [s]."""
    # A line without delay passes its signal on (`line_value`), and its unread states must stay
    # finite. A line with a negative delay would diverge, and a run that ends at 1e100 might count
    # as a success. NaN makes it fail at once.
    return jnp.where(delay > 0, delay, jnp.where(delay == 0, _UNREAD, jnp.nan))


def require_past(model: Model, params: Record) -> None:
    """Raise if a delay line has a negative delay.

    Raises:
        ValueError: with the signal and its delay.
    """
    for name, parameter in model.delay_lines:
        delay = float(getattr(params, parameter))
        if delay < 0:
            raise ValueError(
                f"{parameter} of model {model.name}: {name!r} has a delay line, expected 0 s or "
                f"more, got {delay:g} s"
            )


def line_rates(past: Sequence[Any], value: Any, delay: Any) -> list[Any]:
    r"""Return the time derivatives of a delay line's states.

    $\tau\dot m_i = (2i+1)\left[(-1)^i u - \sum_j a_{ij} m_j\right]$ with a_ij = 1 for j > i, else
    $(-1)^{i-j}$ (Voelker, Kajic and Eliasmith, 2019). The sum of all m is u one delay ago. All
    derivatives are NaN for negative tau.

    Args:
        delay: tau [s].
    """
    rates, delay = [], _possible(delay)
    for i in range(len(past)):
        # The signal enters at the near end, where Legendre polynomials alternate between 1 and -1.
        change = value if i % 2 == 0 else -value
        for j, m in enumerate(past):
            change = change - m if j > i or (i - j) % 2 == 0 else change + m
        # The rates grow as 1/delay. Below about 12 ms they are too fast for the steps of at most 5
        # ms that nonlinear models use.
        rates.append((2 * i + 1) / delay * change)
    return rates
