"""Rate loops that fly along: the flybarless unit about roll and pitch, the gyro of the tail."""

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
"""sticks; or by stick the rate that it commands, a state, or p, q or r where the model's angles are
Euler angles; None: those of the model's axes"""

_BODY = {"roll": "p", "pitch": "q", "yaw": "r"}
"""by axis the rate that a gyro on the body measures"""


class Law(NamedTuple):
    """Parts of a rate loop."""

    command: bool
    """whether the stick commands a rate; else it goes to the swashplate, less the feedback"""
    integral: bool
    """of the rate error: the heading or attitude is held"""
    feedforward: bool
    lag: bool
    """of the gyro, first order"""


def with_rate_loop(
    model: Model,
    on: Loops = None,
    *,
    integral: bool = True,
    feedforward: bool = True,
    lag: bool = False,
) -> Model:
    r"""The model with a flybarless unit: sticks command rates, which PI loops and a feed-forward
    make.

    The rate is that which a gyro on the body measures: p, q or r where the model's angles are Euler
    angles (`Model.body_rates`), else the state that is the axis's rate.

    $\delta = K_{ff} r_c + K_p (r_c - r) + K_i \int (r_c - r)\,dt$ with the command
    $r_c = K_c u$, u the stick and r the rate. The stick keeps the unit of the input in whose
    place it stands.

    New parameters, with `STICK` the input's name: `Kc_STICK` [the rate's unit per unit of stick],
    `Kp_STICK`, `Ki_STICK`, `Kff_STICK`, with a lag `tau_gyro_STICK` [s]. New states: the integral
    of the rate error, `STICK_integral`, and the lagged rate, `STICK_gyro`. An input that is late in
    the model is late within the loop: by a delay line (`with_delays`).

    Args:
        model: with servos already, where it has them (`with_servos`): they are in the loop.
        on: the sticks; by stick its rate where the model's axes do not say it: a state, or p, q or
            r of a model with `body_rates`; None for those of the model's roll and pitch axes.
        lag: whether the unit's gyro is low-passed, tau dr_m/dt = r - r_m.

    Raises:
        ValueError: no such stick, no rate known for it, one whose unit is not that of an angular
            rate, or a name that is taken.
    """
    check_model(model)
    loops = _loops(model, on, ("roll", "pitch"))
    return _with_loops(model, loops, Law(True, integral, feedforward, lag), "rate-loop")


def with_gyro(
    model: Model, on: Loops = None, *, heading_hold: bool = True, lag: bool = True
) -> Model:
    r"""The model with a gyro on the tail: the pedal is a rate command, the heading is held.

    $\delta = K_p (r_c - r_m) + K_i \int (r_c - r_m)\,dt$, $r_c = K_c u$,
    $\tau\,\dot r_m = r - r_m$; without heading hold a damper, $\delta = u - K_p r_m$. The names
    are those of `with_rate_loop`.

    Args:
        model: with the tail's servo already, where it has one.
        on: the pedal, as the sticks of `with_rate_loop`; None for that of the yaw axis.
        heading_hold: whether the pedal commands a rate, with an integral of its error.

    Raises:
        ValueError: no such pedal, no rate known for it, one whose unit is not that of an angular
            rate, or a name that is taken.
    """
    check_model(model)
    law = Law(heading_hold, heading_hold, False, lag)
    return _with_loops(model, _loops(model, on, ("yaw",)), law, "gyro")


def _loops(model: Model, on: Loops, axes: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Sticks with their rates: states, or those of the body."""
    # The model's axes say which rate a stick turns: most loops need no table of their own.
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
    """Sticks with their rates, each of which is an angular rate."""
    for stick, rate in loops.items():
        _check_rate(model, stick, rate)
    return tuple(loops.items())


def _measured_by_gyro(model: Model, axis: Axis) -> str:
    """The rate about an axis as a gyro on the body has it."""
    # The derivatives of Euler angles are no rates of the body: in a steady turn at a bank the body
    # pitches although theta stays.
    return axis.rate if model.body_rates is None else _BODY.get(axis.name, axis.rate)


def _is_of_body(model: Model, rate: str) -> bool:
    """True if a rate is computed from the state, and is none of its fields."""
    states = naming.names(model.State)
    return model.body_rates is not None and rate in _BODY.values() and rate not in states


def _unit_of(model: Model, rate: str) -> str | None:
    return "rad/s" if _is_of_body(model, rate) else naming.unit(model.State, rate)


def _check_rate(model: Model, stick: str, rate: str) -> None:
    """Refuse what is no state, and a state whose unit is not that of an angular rate."""
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
    except ValueError:  # a unit of the user's own, of which nobody knows what it measures
        return
    # A file may leave the radian out.
    if kind not in (None, {"s": -1, "rad": 1}, {"s": -1}):
        raise ValueError(
            f"{stick}: {rate!r} of model {model.name} is in {unit}, expected the state that is the "
            "rate, in rad/s or 1/s"
        )


@functools.cache
def _with_loops(model: Model, loops: tuple[tuple[str, str], ...], law: Law, suffix: str) -> Model:
    for stick, _ in loops:
        _check_free(model, stick)
        # The loop computes the input from the state at hand, so there is no record of it to read
        # further back, as exact delays do: the past has to be carried along in states.
        if stick in dict(model.delays):
            model = with_delay_line(model, stick)
    return _RateLoop(model, loops, law).made(
        suffix, lambda bare: _with_loops(bare, loops, law, suffix)
    )


def _check_free(model: Model, stick: str) -> None:
    """Refuse a stick that drives a loop already."""
    looped = {"rate-loop", "gyro"} & set(model.name.split("+")[1:])
    if looped and f"Kp_{stick}" in naming.names(model.Params):
        # Both would be proportional and integral of the same rate, exchangeable in any log.
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
            # The stick of the loop takes the place and the unit of the input that it drives, so
            # that a log of sticks fits the model with its loop and without.
            unit = naming.unit(model.Inputs, stick), _unit_of(model, rate)
            params |= _gains(stick, *unit, law)
            if law.integral:
                angle = quotient(unit[1], "1/s")
                # The integral is an angle and a state: it remembers, which makes a heading hold of
                # a rate loop.
                states[f"{stick}_integral"] = Quantity(angle, f"integral of the error of {rate}")
            if law.lag:
                states[f"{stick}_gyro"] = Quantity(unit[1], f"{rate} as measured by the gyro")
        linear = not any(_is_of_body(model, rate) for _, rate in loops)
        super().__init__(model, Parts(params, states, linear=linear))
        self.loops, self.law = loops, law

    def rate(self, s: Record, name: str) -> Any:
        """The rate itself."""
        if _is_of_body(self.model, name) and self.model.body_rates is not None:
            return self.model.body_rates(s)[name]
        return getattr(s, name)

    def seen(self, s: Record, stick: str, rate: str) -> Any:
        """The rate as the loop has it."""
        return getattr(s, f"{stick}_gyro") if self.law.lag else self.rate(s, rate)

    def inputs(self, p: Record, s: Record, u: Record) -> Record:
        """Commands of the loops in place of their sticks; other inputs pass."""
        driven = {}
        for stick, rate in self.loops:
            # From the state and not from an output: an output may be delayed or filtered by the
            # sensors of the log, which are not those of the loop.
            measured, gain = self.seen(s, stick, rate), getattr(p, f"Kp_{stick}")
            if not self.law.command:
                # A damper has no Kc: a gain before the pedal would be exchangeable with the pedal's
                # own effect.
                driven[stick] = getattr(u, stick) - gain * measured
                continue
            command = getattr(p, f"Kc_{stick}") * getattr(u, stick)
            driven[stick] = gain * (command - measured)
            if self.law.feedforward:
                # It stands outside the loop: it changes what the stick does, not poles and margins.
                # So a record with the stick at rest, or flown by gusts alone, says nothing of it.
                driven[stick] = driven[stick] + getattr(p, f"Kff_{stick}") * command
            if self.law.integral:
                held = getattr(p, f"Ki_{stick}") * getattr(s, f"{stick}_integral")
                driven[stick] = driven[stick] + held
        return naming.replace(u, **driven)

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """The derivatives of integrals and lagged rates, per second."""
        rates = {}
        for stick, rate in self.loops:
            measured = self.seen(s, stick, rate)
            if self.law.integral:
                command = getattr(p, f"Kc_{stick}") * getattr(u, stick)
                # Nothing limits the integral: no device here has end stops that it could wind up
                # against, and a rate limit of the servos delays what is asked for without holding
                # it.
                rates[f"{stick}_integral"] = command - measured
            if self.law.lag:
                lag = getattr(p, f"tau_gyro_{stick}")
                rates[f"{stick}_gyro"] = (self.rate(s, rate) - measured) / lag
        return rates


def _gains(stick: str, of_stick: str | None, of_rate: str | None, law: Law) -> dict[str, Quantity]:
    """The parameters of one loop; the stick's unit is that of the input that it drives."""
    per_rate = quotient(of_stick, of_rate)
    # None of the gains is marked positive: their sign depends on that of the input's effect, which
    # is how a servo is mounted.
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
