"""Delays of single inputs and outputs, each a parameter."""

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
"""states of a delay line: at 2/delay rad/s its error is 2e-4, at 4/delay 3 %"""
_HIGHEST = 8

type Late = Sequence[str] | Mapping[str, str]
"""names, each with the parameter delay_NAME; or names with the parameter that is their delay"""


def with_delays(
    model: Model, inputs: Late = (), outputs: Late = (), *, order: int = ORDER
) -> Model:
    """The model with pure delays on inputs and outputs, each by a parameter [s].

    An input acts late exactly (`Model.delays`), and its delay may be negative: the stick was logged
    late. An output is late by a delay line of `order` states, `OUTPUT_late0` and so on: the Pade
    approximation [order - 1/order] of exp(-s delay) in coordinates of the output's own past, the
    coefficients of Legendre polynomials over the delay (Voelker, Kajic and Eliasmith, 2019). It is
    linear, so that matrices, modes, filters and windows have it too, and differentiable.

    Args:
        inputs: those that act late: names, or by name the parameter (which several may share).
        order: states of each output's delay line, 1 to 8.

    Raises:
        ValueError: no such input or output, one that is late already, or a name that is taken.
    """
    check_model(model)
    if not (isinstance(order, int) and 1 <= order <= _HIGHEST):
        raise ValueError(f"order: expected 1 to {_HIGHEST} states, got {order!r:.20}")
    # Two ways, and not one for both: an input is a record, which can be read at any other time,
    # exactly. An output is computed, and its past is there only if states carry it.
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
    """The model whose inputs are late by new parameters.

    Raises:
        ValueError: an input is late already, or the model has a parameter of that name.
    """
    return _with_input_delays(model, tuple(parameters.items()))


@functools.cache
def _with_input_delays(model: Model, parameters: tuple[tuple[str, str], ...]) -> Model:
    on_time(model, (n for n, _ in parameters))
    new: dict[str, list[str]] = {}
    for name, parameter in parameters:
        # Several inputs may name one parameter, as all sticks go through one radio: one unknown for
        # all.
        new.setdefault(parameter, []).append(name)
    fields = {}
    for parameter, names in new.items():
        if parameter in naming.names(model.Params):
            raise ValueError(
                f"model {model.name} has a parameter {parameter!r} already, expected another name"
            )
        # NaN and not zero: a delay that nobody gave is asked for, there is no hidden default. It
        # may become negative, for a stick that is logged late, so it is not marked positive as
        # those of outputs are.
        quantity = Quantity("s", f"delay of {', '.join(names)}", math.nan)
        fields[parameter] = (quantity.annotation, math.nan)
    return dataclasses.replace(
        model,
        name=f"{model.name}+delays",
        Params=naming.extended(model.Params, f"{model.Params.__name__}Late", fields),
        delays=(*model.delays, *parameters),
    )


def on_time(model: Model, names: Iterable[str]) -> None:
    """Refuse an input that is late already.

    Raises:
        ValueError: naming it and its delay.
    """
    late = dict(model.delays)
    for name in names:
        if name in late:
            raise ValueError(
                f"input {name!r} of model {model.name} is late by {late[name]} already, expected "
                "one delay"
            )


@functools.cache
def _with_output_delays(model: Model, late: tuple[tuple[str, str], ...], order: int) -> Model:
    require((n for n, _ in late), model.Outputs, "output", model)
    for _, parameter in late:
        if parameter in naming.names(model.Params):
            raise ValueError(
                f"model {model.name} has a parameter {parameter!r} already, expected another name"
            )
    # Delays are also kept by name in `delay_lines`: a fit with a free delay has several starts.
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
        # The states are the past of the output over the delay, so they have its unit, and a line's
        # delay has to be positive: it remembers, and cannot look ahead as a reader of a log can.
        units = {n: naming.unit(model.Outputs, n) for n in late}
        states = {
            state: Quantity(units[n], f"past of {n}, Legendre coefficient {i}")
            for n in late
            for i, state in enumerate(line_states(n, order))
        }
        super().__init__(model, Parts(params, states))
        self.late, self.order = late, order

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """The derivatives of the lines' states, per second."""
        measured = self.measured(p, s, u)
        rates = {}
        for n, parameter in self.late.items():
            line = line_states(n, self.order)
            past = [getattr(s, state) for state in line]
            changes = line_rates(past, getattr(measured, n), getattr(p, parameter))
            rates |= dict(zip(line, changes, strict=True))
        return rates

    def shown(self, p: Record, s: Record, u: Record, y: Record) -> Record:
        """The outputs, those that are late read from their lines."""
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
        # As if the vehicle had always been where it starts: the first coefficient is the mean.
        # At rest at zero instead, the line would show a step from zero to the first output, one
        # delay long, which no flight has.
        at_first = self.model.output(p, self.model.initial_state(p), zeros(self.model.Inputs))
        first = super().first(p)
        return first | {line_states(n, 1)[0]: getattr(at_first, n) for n in self.late}


@functools.cache
def with_delay_line(model: Model, name: str, order: int = ORDER) -> Model:
    """The model with the delay of one input as a delay line among its states: within a feedback
    loop the input is no record that could be read further back.
    """
    device = _LateInput(model, name, dict(model.delays)[name], order)
    # The delay of this input is no longer one of the record: left in both places it would act
    # twice.
    rest = tuple((n, parameter) for n, parameter in model.delays if n != name)
    return device.made(
        "delay-line",
        lambda bare: with_delay_line(bare, name, order),
        delays=rest,
        # A log can be read ahead, for a stick that it has late; a line has the past alone.
        positive=(*model.positive, device.parameter),
        delay_lines=(*model.delay_lines, (name, device.parameter)),
    )


class _LateInput(Device):
    """A delay line on one input; its delay is a parameter that the model has."""

    def __init__(self, model: Model, name: str, parameter: str, order: int) -> None:
        unit = naming.unit(model.Inputs, name)
        states = {
            state: Quantity(unit, f"past of {name}, Legendre coefficient {i}")
            for i, state in enumerate(line_states(name, order))
        }
        super().__init__(model, Parts({}, states))
        self.name, self.parameter = name, parameter

    def inputs(self, p: Record, s: Record, u: Record) -> Record:
        """The inputs, the late one read from its line."""
        past = [getattr(s, n) for n in self.parts.states]
        late = line_value(past, getattr(u, self.name), getattr(p, self.parameter))
        return naming.replace(u, **{self.name: late})

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """The derivatives of the line's states, per second."""
        past = [getattr(s, n) for n in self.parts.states]
        changes = line_rates(past, getattr(u, self.name), getattr(p, self.parameter))
        return dict(zip(self.parts.states, changes, strict=True))


def line_states(name: str, order: int) -> tuple[str, ...]:
    """The names of a delay line's states."""
    return tuple(f"{name}_late{i}" for i in range(order))


def line_value(past: Sequence[Any], value: Any, delay: Any) -> Any:
    """Return the output of a delay line: the signal one delay ago, or the current value without
    delay.

    Args:
        delay: [s].
    """
    return jnp.where(delay == 0, value, line_end(past))


def line_end(past: Sequence[Any]) -> Any:
    """The signal at the far end of a delay line of one state at least, one delay ago."""
    # Shifted Legendre polynomials are all one there: the sum of the coefficients is the value.
    return sum(past)


_UNREAD = 0.02
"""[s], the delay of a line of which nothing is read: fast, but not for a solver's steps"""


def _possible(delay: Any) -> Any:
    """The delay by which a line's rates are divided [s]."""
    # A line of no delay passes its signal on (`line_value`), and its states, which nothing reads,
    # stay finite. One that looked ahead would diverge: a run of it might end at 1e100 and be called
    # a success, so that it is not a number from the beginning.
    return jnp.where(delay > 0, delay, jnp.where(delay == 0, _UNREAD, jnp.nan))


def require_past(model: Model, params: Record) -> None:
    """Refuse a delay line that would look ahead.

    Raises:
        ValueError: naming the signal and its delay.
    """
    for name, parameter in model.delay_lines:
        delay = float(getattr(params, parameter))
        if delay < 0:
            raise ValueError(
                f"{parameter} of model {model.name}: {name!r} is late by a delay line, expected "
                f"0 s or more, got {delay:g} s"
            )


def line_rates(past: Sequence[Any], value: Any, delay: Any) -> list[Any]:
    r"""The derivatives of a delay line's states, per second.

    $\tau\dot m_i = (2i+1)\left[(-1)^i u - \sum_j a_{ij} m_j\right]$ with a_ij = 1 for j > i, else
    $(-1)^{i-j}$ (Voelker, Kajic and Eliasmith, 2019). The sum of all m is u one delay ago. All are
    NaN where tau is negative.

    Args:
        delay: tau [s].
    """
    rates, delay = [], _possible(delay)
    for i in range(len(past)):
        # The signal enters at the near end of the delay, where Legendre's polynomials are 1 and -1
        # in turn.
        change = value if i % 2 == 0 else -value
        for j, m in enumerate(past):
            change = change - m if j > i or (i - j) % 2 == 0 else change + m
        # The line's rates grow as one over the delay. One of less than about 12 ms is too fast for
        # the steps of 5 ms at most in which models that are not linear are solved.
        rates.append((2 * i + 1) / delay * change)
    return rates
