"""Servos between stick and swashplate."""

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Model
from heli_jax.dynamics.onboard.delays import on_time, with_input_delays
from heli_jax.dynamics.onboard.device import Device, Parts, Quantity, quotient, require
from heli_jax.naming import Record


def with_servos(
    model: Model,
    on: Sequence[str],
    *,
    rate_limit: bool = False,
    delay: bool = False,
    name: str = "servo",
) -> Model:
    r"""Return the model with equal servos on some of its inputs.

    $\ddot\delta = \omega^2(u - \delta) - 2\zeta\omega\dot\delta$. With a rate limit the commanded
    speed saturates:
    $\ddot\delta = 2\zeta\omega\,(\mathrm{sat}(\omega (u - \delta)/(2\zeta)) - \dot\delta)$. This is
    the same equation below the limit, and $|\dot\delta|$ never exceeds it.

    New parameters: `omega_NAME` [rad/s], the natural frequency (the bandwidth if zeta is 0.707),
    and `zeta_NAME`. A rate limit adds `rate_NAME` [the input's unit per second], a delay adds
    `delay_NAME` [s]. New states: the servo's position and speed, `INPUT_NAME` and
    `INPUT_NAME_rate`.

    Args:
        rate_limit: True for a limited rate, which makes the model nonlinear.
        delay: True for a pure delay, which is exact (`Model.delays`).
        name: suffix of parameters and states, for a second kind of servo.

    Raises:
        ValueError: no such input, one that has a delay already, or a name that is taken.
    """
    check_model(model)
    return _with_servos(model, tuple(on), rate_limit, delay, name)


@functools.cache
def _with_servos(
    model: Model, on: tuple[str, ...], rate_limit: bool, delay: bool, name: str
) -> Model:
    require(on, model.Inputs, "input", model)
    if not name.isidentifier():
        raise ValueError(f"name: expected letters, digits and _, got {name!r:.40}")
    if delay:
        on_time(model, on)
    device = _Servos(model, on, rate_limit, name)

    def again(bare: Model) -> Model:
        return _with_servos(bare, on, rate_limit, delay, name)

    # Delay and servo commute. A delay outside the servo acts on the input's record, so it is exact
    # and needs no states.
    made = device.made(f"{name}s", again)
    return with_input_delays(made, dict.fromkeys(on, f"delay_{name}")) if delay else made


class _Servos(Device):
    """Second-order servos on some inputs."""

    def __init__(self, model: Model, on: tuple[str, ...], rate_limit: bool, name: str) -> None:
        params = {
            f"omega_{name}": Quantity("rad/s", "servo's natural frequency", math.nan, True),
            f"zeta_{name}": Quantity("1", "servo's damping ratio", math.nan, True),
        }
        if rate_limit:
            # Equal servos share the limit, so their inputs must have one unit.
            unit = quotient(_one_unit(model, on), "s")
            params[f"rate_{name}"] = Quantity(unit, "servo's greatest speed", math.nan, True)
        states = {}
        for n in on:
            unit = naming.unit(model.Inputs, n)
            states[f"{n}_{name}"] = Quantity(unit, f"position of the servo of {n}")
            states[f"{n}_{name}_rate"] = Quantity(quotient(unit, "s"), f"speed of the servo of {n}")
        super().__init__(model, Parts(params, states, linear=not rate_limit))
        self.on, self.rate_limit, self.name = on, rate_limit, name

    def inputs(self, p: Record, s: Record, u: Record) -> Record:
        """Return the inputs, with servo positions in place of their commands."""
        return naming.replace(u, **{n: getattr(s, f"{n}_{self.name}") for n in self.on})

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the time derivatives of positions and speeds."""
        omega, zeta = (getattr(p, f"{k}_{self.name}") for k in ("omega", "zeta"))
        rates = {}
        for n in self.on:
            position, speed = f"{n}_{self.name}", f"{n}_{self.name}_rate"
            # A position loop around a speed loop gives a commanded speed, which a limit can act on.
            commanded = omega / (2.0 * zeta) * (getattr(u, n) - getattr(s, position))
            # Limit the commanded speed: a clipped state would wind up behind its limit and leave it
            # late.
            if self.rate_limit:
                most = getattr(p, f"rate_{self.name}")
                commanded = jnp.clip(commanded, -most, most)
            rates[position] = getattr(s, speed)
            rates[speed] = 2.0 * zeta * omega * (commanded - getattr(s, speed))
        return rates


def _one_unit(model: Model, on: tuple[str, ...]) -> str | None:
    units = {naming.unit(model.Inputs, n) for n in on}
    if len(units) > 1:
        raise ValueError(
            f"rate_limit: expected inputs of one unit for a common limit, got {', '.join(on)} in "
            f"{', '.join(sorted(str(u) for u in units))}"
        )
    return units.pop()
