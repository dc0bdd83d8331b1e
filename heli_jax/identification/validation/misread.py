"""Numbers that are hardly what they are taken for: degrees for radians, a rate for a stick, a
sensor's dropouts for measurements.

What a record says by itself of units is little: degrees fit as well as radians where all outputs
are in them, with every estimate off by 57. Their size is the only evidence.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax import naming, units
from heli_jax.dynamics.model import Model, axes_of
from heli_jax.finding import UNIT_IN_DOUBT, Finding
from heli_jax.flights.channel_names import no_stick, unit_in_name
from heli_jax.flights.flight import Flight, Signal
from heli_jax.flights.signal_facts import DROP_SHARE
from heli_jax.flights.table import shown
from heli_jax.identification.estimation.evaluation import evaluate, pseudoinverse
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.signal_quality import Facts, cut_off, dropout_words
from heli_jax.identification.validation.signal_signs import rate_against_angle
from heli_jax.vehicle import of_helicopter

_LARGEST_ANGLE, _LARGEST_RATE = np.pi, 20.0
"""rad and rad/s that a small helicopter does not exceed, but for its heading"""
_LINEAR_ANGLE, _LINEAR_RATE = np.pi / 2, 8.0
"""rad and rad/s up to which a linear model may mean something"""
_ATTITUDE = {"p", "q", "r", "phi", "theta", "psi", "roll", "pitch", "yaw"}
"""what the outputs of models without axes (kinematics) and of files are called then"""
_FLOWN_TURNS = 5.0
"""turns that rolls and loops may add up to in an angle without jumps"""
_HEADING_TURNS = 20.0
"""turns in one sense, of a heading without jumps"""
_MOST = 99.0
"""percentile of the size that is held against them: no single spike counts"""


def misread(problem: Problem) -> list[Finding]:
    """Doubts about what the signals of the fitted flights are.

    Args:
        problem: the flights, and the model, whose axes name headings.
    """
    flights = problem.training
    return [
        one
        for label, flight in zip(labels(flights), flights, strict=True)
        for one in (
            *_contradicted(label, flight),
            *degrees_for_radians(problem.model, label, flight),
            *_sticks(label, flight),
        )
    ]


def record_doubts(problem: Problem) -> list[Finding]:
    """All that is doubtful of the fitted flights, apart from any model's fit.

    Args:
        problem: the flights, and the model, whose axes name headings.
    """
    # Of both questions once: sorting long records is what takes the time.
    facts = [flight.facts for flight in problem.training]
    return [
        *misread(problem),
        *dropouts(problem, facts),
        *cut_off(list(zip(labels(problem.training), facts, strict=True))),
        *rate_against_angle(problem),
    ]


def dropouts(problem: Problem, facts: Sequence[Facts]) -> list[Finding]:
    """The signals whose dropouts are taken for values.

    Args:
        problem: the flights.
        facts: of each fitted flight.
    """
    flights = problem.training
    return [
        Finding(
            "quality.dropouts",
            "doubt",
            dropout_words(label, flight, name, one),
            subjects=(name,),
            brief=f"dropouts of {name} are taken for measurements",
            denies=True,
        )
        for label, flight, of_signals in zip(labels(flights), flights, facts, strict=True)
        for (name, _), one in of_signals.items()
        if one.dropouts is not None and one.dropped >= DROP_SHARE
    ]


def _contradicted(label: str, flight: Flight) -> Iterator[Finding]:
    """The signals of which the file states another unit than the configuration."""
    source = flight.source
    for name, signal in ({**source.inputs, **source.outputs} if source else {}).items():
        if not signal.contradicted:
            continue
        unit = signal.unit or "1"
        try:
            factor = units.factor(signal.unit, signal.contradicted)
            off = f"{name} is {factor:.3g} times as large as it was"
        except ValueError:
            off = f"{name} is no such quantity"
        words = (
            f"{label}: {name} is read as {unit}, as configured, where the file says "
            f"{shown(signal.contradicted)} of {shown(signal.name)}: if the file is right, {off}, "
            "and the estimates are wrong with it; without unit the file's is taken."
        )
        brief = f"the file says {shown(signal.contradicted)} of {name}"
        yield Finding(UNIT_IN_DOUBT, "doubt", words, subjects=(name,), brief=brief)


def degrees_for_radians(model: Model, label: str, flight: Flight) -> Iterator[Finding]:
    """Angles and rates that are too large to be in the unit that they are read in.

    Args:
        model: whose axes say which outputs are attitudes and rates.
        label: of the flight.
        flight: as read from a log.
    """
    headings = {a.angle for a in axes_of(model) if a.rate == "r"} | {"psi", "yaw"}
    for name, signal in (flight.source.outputs if flight.source else {}).items():
        values = flight.outputs.get(name)
        if values is None or signal.unit not in ("rad", "rad/s") or signal.scale != 1.0:
            continue
        seen = np.abs(values[np.isfinite(values)])
        unit = "deg" if signal.unit == "rad" else "deg/s"
        # The shaft of a motor turns as often as it likes, and a rotor faster than any fuselage; so
        # may the angle of a nonlinear model of one's own, such as a pendulum.
        turns = unit == "deg" and not (model.linear or of_helicopter(model.Params))
        judged = (_of_fuselage(model, str(name)) and not turns) or signal.contradicted == unit
        if not seen.size or not judged:
            continue
        size, linear = float(np.percentile(seen, _MOST)), model.linear
        if signal.unit == "rad/s":
            limits = (_LARGEST_RATE, _LINEAR_RATE)
        elif name in headings:
            limits = (_HEADING_TURNS * 2 * np.pi,) * 2
        else:
            limits = (_LARGEST_ANGLE, _LINEAR_ANGLE)
        impossible, most = limits[0], limits[1] if linear else limits[0]
        if size <= most:
            continue
        whose = (
            "a linear model says nothing of" if size <= impossible else "no small helicopter has"
        )
        words = (
            f"{label}: {name} is up to {size:.3g} {signal.unit} ({np.degrees(size):.0f} {unit}), "
            f"which {whose}: {shown(signal.name)} looks like {unit} read as {signal.unit}; state "
            f"unit: {unit}."
        )
        criterion = f"{_MOST:g} % of the samples below, {most:.4g} {signal.unit}"
        # What the file says of it makes sure what its size alone does not. An angle past pi that
        # its own rate leads to may have been flown: then the size says nothing.
        flown = _flown(model, flight, str(name), size)
        if flown and signal.contradicted != unit:
            words = (
                f"{label}: {name} is up to {size:.3g} rad ({np.degrees(size):.0f} deg): it was "
                f"flown upside down, or {shown(signal.name)} and its rate are in deg and read as "
                "rad, with every estimate off by 57; state unit: deg if so."
            )
        certain = (size > impossible and not flown) or signal.contradicted == unit
        brief = f"{name} looks like {unit} read as {signal.unit}"
        # What was flown upside down is in its own unit as likely as not.
        code = "units.flown-or-degrees" if flown and not certain else UNIT_IN_DOUBT
        yield Finding(
            code, "doubt", words, size, criterion, (str(name),), brief=brief, denies=certain
        )


def _of_fuselage(model: Model, name: str) -> bool:
    """Whether an output is an attitude or a rate of the machine, and no other angle of it."""
    of_axes = {n for a in axes_of(model) for n in (a.rate, a.angle)}
    return name in of_axes | _ATTITUDE or of_helicopter(model.Params)


def _flown(model: Model, flight: Flight, name: str, size: float) -> bool:
    """Whether an angle of some turns is what its rate, of a size that a helicopter has, adds up to:
    so it is in aerobatics, and where both are in degrees."""
    rate = next((a.rate for a in axes_of(model) if a.angle == name), None)
    p, phi = flight.outputs.get(rate or ""), flight.outputs[name]
    if p is None or size > _FLOWN_TURNS * 2 * np.pi or np.nanmax(np.abs(p)) > _LARGEST_RATE:
        return False
    seen, rated = np.isfinite(phi), np.isfinite(p)
    if not rated.any():
        return False
    # From one sample of the angle to its next, which a slower sensor has seconds later.
    at = np.arange(p.size)
    p = np.interp(at, at[rated], p[rated])
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (p[1:] + p[:-1]) * flight.dt)])
    moved, by_rate = np.diff(phi[seen]), np.diff(turned[seen])
    power = float(np.sum(by_rate**2))
    return power > 0 and abs(float(np.sum(moved * by_rate)) / power - 1.0) < 0.3


def _sticks(label: str, flight: Flight) -> Iterator[Finding]:
    for name, signal in (flight.source.inputs if flight.source else {}).items():
        if signal.constant is not None:
            continue
        what = no_stick(signal.name, unit_in_name(signal.name), signal.si, sure=True)
        if what:
            words = (
                f"{label}: {name} is taken from {shown(signal.name)}, which by its name is {what}: "
                "a motion that is taken for the stick makes numbers that mean nothing; name the "
                "stick's channel."
            )
            yield Finding(
                "signs.no-stick",
                "doubt",
                words,
                subjects=(name,),
                brief=f"{name} is {what} by its name",
                denies=True,
            )


# Whether an input's numbers are of the unit that they are said to be in.
#
# A stick in per cent that is read as plain numbers fits as well as one read right, with its effect
# a hundredth of what it is. Two things together tell: numbers that are large (or small) for the
# unit, and a model that at the start values moves its outputs too far (or not far enough) by about
# as much.


_NEAR = 3.0
"""factor by which start values may be off beside the unit"""
_STEP, _SCALED = 1.001, 0.2
"""factor on a signal, and the relative change of a parameter over its own, from which on the unit
of the signal decides what the parameter is"""
_FULL = 1.2
"""of a stick's or a surface's full travel: 1, or a radian"""


class _Other(NamedTuple):
    """A unit that numbers may have had in place of the one that was stated."""

    unit: str
    factor: float
    """of the stated unit over this one"""


def doubtful_inputs(
    flights: Sequence[tuple[str, Flight]],
    simulated: Sequence[Mapping[str, np.ndarray]],
    sticks: Mapping[str, str] | None = None,
) -> list[Finding]:
    """A doubt for each input that looks like degrees for radians, per cent for plain numbers, or
    the reverse.

    Args:
        flights: by what each is called.
        simulated: at the start values, by flight and output (N,), SI.
        sticks: by output the input that moves it, of `signal_signs.sticks_of`; without it any.
    """
    findings = []
    for (label, flight), run in zip(flights, simulated, strict=True):
        for name, signal in (flight.source.inputs if flight.source else {}).items():
            if signal.constant is not None:
                continue
            other = _other(signal, flight.inputs[name])
            moved = [n for n in flight.outputs if (sticks or {}).get(n, name) == name]
            sizes = [_size(flight.outputs[n], run[n]) for n in moved]
            if other is None or not sizes:
                continue
            if all(s and other.factor / _NEAR < s < other.factor * _NEAR for s in sizes):
                findings.append(_said(label, name, signal, other, moved, sizes))
    return findings


def scaled_by(at: Solution, name: str) -> tuple[str, ...]:
    """The parameters that another unit of a signal would change by a good part of its factor.

    Args:
        at: where the fit ended.
        name: of the input or output.
    """
    layout, data = at.layout, at.data
    flights = []
    for flight in data.flights:
        outputs = {n: y * _STEP if n == name else y for n, y in flight.outputs.items()}
        inputs = {n: u * _STEP if n == name else u for n, u in naming.asdict(flight.inputs).items()}
        flights.append(
            flight._replace(outputs=outputs, inputs=naming.replace(flight.inputs, **inputs))
        )
    e = evaluate(*at)
    other = evaluate(layout, data._replace(flights=tuple(flights)), at.noise, at.z)
    step = pseudoinverse(np.asarray(e.J)) @ (np.asarray(e.r) - np.asarray(other.r))
    values, slopes = np.asarray(e.named), np.asarray(e.slopes)
    change = step[: slopes.size] * slopes / (_STEP - 1.0)
    return tuple(
        n
        for n, c, v in zip(layout.of_interest, change, values, strict=True)
        if abs(c) > _SCALED * abs(v)
    )


def _other(signal: Signal, values: np.ndarray) -> _Other | None:
    """What the numbers of an input may be instead, by their size in the stated unit."""
    if signal.unit in ("rad", "deg", "%"):
        stated = signal.unit
    elif units.is_plain(signal.unit):
        stated = "1"
    else:
        return None
    size = float(np.max(np.abs(values), initial=0.0)) / units.factor(signal.unit, signal.si)
    for small, large in (("rad", "deg"), ("1", "%")):
        # Of the larger unit no more than its full travel, so that a motor's speed is none.
        per = 1.0 / units.factor(large, small)
        if stated == small and _FULL < size <= _FULL * per:
            return _Other(large, 1.0 / per)
        if stated == large and size <= _FULL:
            return _Other(small, per)
    return None


def _size(measured: np.ndarray, simulated: np.ndarray) -> float:
    """How many times as far an output moves as was simulated; 0 where nothing can be told."""
    seen = np.isfinite(measured)
    with np.errstate(over="ignore", invalid="ignore"):
        far = float(np.std(simulated[seen])) if seen.any() else 0.0
    return float(np.std(measured[seen])) / far if far > 0 and np.isfinite(far) else 0.0


def _said(
    label: str,
    name: str,
    signal: Signal,
    other: _Other,
    moved: Sequence[str],
    sizes: Sequence[float],
) -> Finding:
    now = signal.unit if signal.unit in ("rad", "deg", "%") else "plain numbers"
    was = "plain numbers" if other.unit == "1" else other.unit
    move = "move" if len(moved) > 1 else "moves"
    words = (
        f"{label}: at the start values {' and '.join(moved)} {move} "
        f"{', '.join(f'{s:.2g}' for s in sizes)} times as far as simulated: {shown(signal.name)} "
        f"looks like {was} read as {now}, with the effect of {name} off by "
        f'{max(other.factor, 1.0 / other.factor):.3g}; state unit: "{other.unit}" if so.'
    )
    criterion = f"within a factor of {_NEAR:g} of {other.factor:.3g}"
    return Finding(
        UNIT_IN_DOUBT,
        "doubt",
        words,
        max(sizes),
        criterion,
        (name,),
        brief=f"the unit of {name} is in doubt",
    )
