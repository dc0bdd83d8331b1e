"""Rate loops: the flybarless unit of roll and pitch, and the tail gyro."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from heli_jax import naming, units
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Axis, Model, axes_of
from heli_jax.dynamics.onboard.delays import with_delay_line
from heli_jax.dynamics.onboard.device import Device, Parts, Quantity, quotient, require
from heli_jax.errors import nearest
from heli_jax.naming import Record

type Loops = Sequence[str] | Mapping[str, str] | None
"""Sticks; or a mapping of sticks to the rates that they command; None for the model's axes.

A rate is a state, or p, q or r if the model has Euler angles.
"""

_BODY = {"roll": "p", "pitch": "q", "yaw": "r"}
"""Rate that a gyro on the body measures, by axis."""


class Law(NamedTuple):
    """Options of a rate loop."""

    command: bool
    """True if the stick commands a rate; otherwise the feedback is subtracted from the stick."""
    integral: bool
    """True for an integral of the rate error, which holds heading or attitude."""
    feedforward: bool
    lag: bool
    """True for a first-order lag of the gyro."""


def with_rate_loop(
    model: Model,
    on: Loops = None,
    *,
    integral: bool = True,
    feedforward: bool = True,
    lag: bool = False,
) -> Model:
    r"""Return the model with a flybarless unit: PI loops and a feed-forward track commanded rates.

    $\delta = K_{ff} r_c + K_p (r_c - r) + K_i \int (r_c - r)\,dt$ with $r_c = K_c u$, stick u and
    rate r. The stick has the unit of the input that it replaces. The rate is that of a gyro on the
    body: p, q or r if the model has Euler angles (`Model.body_rates`), otherwise the axis's rate.

    New parameters, with `STICK` the input's name: `Kc_STICK` [the rate's unit per unit of stick],
    `Kp_STICK`, `Ki_STICK`, `Kff_STICK`, with a lag `tau_gyro_STICK` [s]. New states: the integral
    of the rate error, `STICK_integral`, and the lagged rate, `STICK_gyro`. An input delay of the
    model becomes a delay line within the loop (`with_delays`).

    Args:
        model: includes its servos (`with_servos`), since they are in the loop.
        on: sticks, or a mapping of sticks to rates if the model's axes do not define them. None for
            the sticks of the roll and pitch axes.
        lag: True for a low-pass of the unit's gyro, tau dr_m/dt = r - r_m.

    Raises:
        ValueError: no such stick, no rate known for it, a unit other than an angular rate's, or a
            name that is taken.
    """
    check_model(model)
    loops = _loops(model, on, ("roll", "pitch"))
    return _with_loops(model, loops, Law(True, integral, feedforward, lag), "rate-loop")


def with_gyro(
    model: Model, on: Loops = None, *, heading_hold: bool = True, lag: bool = True
) -> Model:
    r"""Return the model with a tail gyro: the pedal commands a yaw rate, and the heading is held.

    $\delta = K_p (r_c - r_m) + K_i \int (r_c - r_m)\,dt$, $r_c = K_c u$, $\tau\,\dot r_m = r -
    r_m$. Without heading hold it is a damper, $\delta = u - K_p r_m$. Names are as in
    `with_rate_loop`.

    Args:
        model: includes the tail's servo, since it is in the loop.
        on: the pedal, as the sticks of `with_rate_loop`; None for that of the yaw axis.
        heading_hold: True if the pedal commands a rate, with an integral of its error.

    Raises:
        ValueError: no such pedal, no rate known for it, a unit other than an angular rate's, or a
            name that is taken.
    """
    check_model(model)
    law = Law(heading_hold, heading_hold, False, lag)
    return _with_loops(model, _loops(model, on, ("yaw",)), law, "gyro")


def _loops(model: Model, on: Loops, axes: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Return sticks with their rates, which are states or body rates."""
    # The model's axes define the rate of most sticks.
    known = {a.stick: _measured_by_gyro(model, a) for a in axes_of(model) if a.stick is not None}
    if on is None:
        own = [a for a in axes_of(model) if a.name in axes and a.stick in known]
        own = [a for a in own if a.stick in naming.names(model.Inputs)]
        if not own:
            raise ValueError(
                f"model {model.name} names no stick of its {' or '.join(axes)} axis, expected on: "
                "{STICK: RATE} with an input and a state"
            )
        return _checked(model, {str(a.stick): _measured_by_gyro(model, a) for a in own})
    require(on, model.Inputs, "input", model)
    if isinstance(on, Mapping):
        return _checked(model, on)
    for stick in on:
        if stick not in known:
            raise ValueError(
                f"model {model.name} does not name the rate that {stick!r} commands, expected on: "
                f"{{{stick!r}: RATE}} with one of its states"
            )
    return _checked(model, {stick: known[stick] for stick in on})


def _checked(model: Model, loops: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """Return sticks with their rates, which must be angular rates."""
    for stick, rate in loops.items():
        _check_rate(model, stick, rate)
    return tuple(loops.items())


def _measured_by_gyro(model: Model, axis: Axis) -> str:
    """Return the rate about an axis that a gyro on the body measures."""
    # Derivatives of Euler angles are not body rates: in a steady banked turn q is not zero although
    # theta is constant.
    return axis.rate if model.body_rates is None else _BODY.get(axis.name, axis.rate)


def _is_of_body(model: Model, rate: str) -> bool:
    """True if a rate is computed from the state and is not a field of it."""
    states = naming.names(model.State)
    return model.body_rates is not None and rate in _BODY.values() and rate not in states


def _unit_of(model: Model, rate: str) -> str | None:
    return "rad/s" if _is_of_body(model, rate) else naming.unit(model.State, rate)


def _check_rate(model: Model, stick: str, rate: str) -> None:
    """Raise if a rate is not a state with the unit of an angular rate."""
    if _is_of_body(model, rate):
        return
    states = naming.names(model.State)
    if rate not in states:
        known = (*states, *_BODY.values()) if model.body_rates is not None else states
        raise ValueError(
            f"{stick}: model {model.name} has no state {rate!r}{nearest(str(rate), known)}"
        )
    unit = naming.unit(model.State, rate)
    try:
        kind = None if unit is None else units.base_of(unit)
    except ValueError:  # a unit that the user defined: its kind is unknown
        return
    # A file may omit the radian.
    if kind not in (None, {"s": -1, "rad": 1}, {"s": -1}):
        raise ValueError(
            f"{stick}: {rate!r} of model {model.name} is in {unit}, expected the state that is the "
            "rate, in rad/s or 1/s"
        )


@functools.cache
def _with_loops(model: Model, loops: tuple[tuple[str, str], ...], law: Law, suffix: str) -> Model:
    for stick, _ in loops:
        _check_free(model, stick)
        # The loop computes the input, so there is no record to read further back. Its past must be
        # kept in states.
        if stick in dict(model.delays):
            model = with_delay_line(model, stick)
    return _RateLoop(model, loops, law).made(
        suffix, lambda bare: _with_loops(bare, loops, law, suffix)
    )


def _check_free(model: Model, stick: str) -> None:
    """Raise if a stick drives a loop already."""
    looped = {"rate-loop", "gyro"} & set(model.name.split("+")[1:])
    if looped and f"Kp_{stick}" in naming.names(model.Params):
        # Both loops would act on the same rate, so no log could distinguish their gains.
        raise ValueError(
            f"{stick} has a rate loop already, expected one of rate_loop and gyro: name the "
            "sticks of each (on: [...])"
        )


class _RateLoop(Device):
    """PI loops about some rates, with a feed-forward."""

    def __init__(self, model: Model, loops: tuple[tuple[str, str], ...], law: Law) -> None:
        params: dict[str, Quantity] = {}
        states: dict[str, Quantity] = {}
        for stick, rate in loops:
            # The loop's stick has the name and unit of the input that it drives. A log of sticks
            # therefore fits the model with and without the loop.
            unit = naming.unit(model.Inputs, stick), _unit_of(model, rate)
            params |= _gains(stick, *unit, law)
            if law.integral:
                angle = quotient(unit[1], "1/s")
                # The integral of the rate error is an angle, which gives heading hold.
                states[f"{stick}_integral"] = Quantity(angle, f"integral of the error of {rate}")
            if law.lag:
                states[f"{stick}_gyro"] = Quantity(unit[1], f"{rate} as measured by the gyro")
        linear = not any(_is_of_body(model, rate) for _, rate in loops)
        super().__init__(model, Parts(params, states, linear=linear))
        self.loops, self.law = loops, law

    def rate(self, s: Record, name: str) -> Any:
        """Return the true rate."""
        if _is_of_body(self.model, name) and self.model.body_rates is not None:
            return self.model.body_rates(s)[name]
        return getattr(s, name)

    def seen(self, s: Record, stick: str, rate: str) -> Any:
        """Return the rate that the loop uses."""
        return getattr(s, f"{stick}_gyro") if self.law.lag else self.rate(s, rate)

    def inputs(self, p: Record, s: Record, u: Record) -> Record:
        """Return the inputs, with the loops' commands in place of their sticks."""
        driven = {}
        for stick, rate in self.loops:
            # Use the state: outputs may be delayed or filtered by the log's sensors, which are not
            # the loop's.
            measured, gain = self.seen(s, stick, rate), getattr(p, f"Kp_{stick}")
            if not self.law.command:
                # A damper has no Kc: no log could distinguish it from the pedal's own effect.
                driven[stick] = getattr(u, stick) - gain * measured
                continue
            command = getattr(p, f"Kc_{stick}") * getattr(u, stick)
            driven[stick] = gain * (command - measured)
            if self.law.feedforward:
                # The feed-forward is outside the loop, so it does not change poles or margins. A
                # record without stick motion does not determine it.
                driven[stick] = driven[stick] + getattr(p, f"Kff_{stick}") * command
            if self.law.integral:
                held = getattr(p, f"Ki_{stick}") * getattr(s, f"{stick}_integral")
                driven[stick] = driven[stick] + held
        return naming.replace(u, **driven)

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the time derivatives of integrals and lagged rates."""
        rates = {}
        for stick, rate in self.loops:
            measured = self.seen(s, stick, rate)
            if self.law.integral:
                command = getattr(p, f"Kc_{stick}") * getattr(u, stick)
                # The integral needs no anti-windup: no device has end stops, and a servo's rate
                # limit only delays its command.
                rates[f"{stick}_integral"] = command - measured
            if self.law.lag:
                lag = getattr(p, f"tau_gyro_{stick}")
                rates[f"{stick}_gyro"] = (self.rate(s, rate) - measured) / lag
        return rates


def _gains(stick: str, of_stick: str | None, of_rate: str | None, law: Law) -> dict[str, Quantity]:
    """Return the parameters of one loop; the stick has the unit of the input that it drives."""
    per_rate = quotient(of_stick, of_rate)
    # No gain is marked positive: the sign depends on how the servo is mounted.
    gains = {f"Kp_{stick}": Quantity(per_rate, f"rate loop of {stick}, proportional", math.nan)}
    if law.command:
        command = quotient(of_rate, of_stick)
        gains[f"Kc_{stick}"] = Quantity(command, f"rate commanded by {stick}", math.nan)
    if law.integral:
        unit = quotient(per_rate, "s")
        gains[f"Ki_{stick}"] = Quantity(unit, f"rate loop of {stick}, integral", math.nan)
    if law.feedforward:
        gains[f"Kff_{stick}"] = Quantity(per_rate, f"feed-forward of {stick}", math.nan)
    if law.lag:
        gains[f"tau_gyro_{stick}"] = Quantity("s", f"lag of the gyro of {stick}", math.nan, True)
    return gains
