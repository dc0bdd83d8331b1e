"""Whether the log is fast enough for the dynamics, at the start values or the estimates.

Two rates count. Outputs that are sampled at less than twice the frequency of a mode show its
aliases. An input that was sampled while it moved is known at its samples alone: between them a
straight line misses a part (pi f / rate)^2 / 3 of a motion at f, a staircase pi f / rate of it. At
twice the frequency nothing is left of the motion; at five times a line misses a seventh.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.analysis.operating_point import operating_point
from heli_jax.dynamics.onboard.filters import states_behind
from heli_jax.finding import Finding, Severity
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.aliases import SHOWS, modes_about
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.numbers import number
from heli_jax.numerics.jumps import split

LOGGING_RATE = "timing.logging-rate"
HOPELESS, ENOUGH = 2.0, 5.0
"""samples in a period of a mode: below the first it is not seen, above the second it is"""
_SETTLED = 1.0
"""the first for a mode that does not swing: in 2 pi of its time constants it is over"""
_PART = 0.1
"""of an output's own motion, from which on a mode matters whatever the noise is guessed to be: a
guess from slow samples takes the motion between them for noise"""
_REGULAR = 0.8
"""part of the steps of a staircase that have the usual length, from which on it is a slow clock"""
_SLOW = 2.0
"""Hz, at which no flight is logged: 500 Hz or more in ms, read as seconds"""
_SLOWER = 1.05
"""steps of the grid, from which on a topic's own is longer"""
_MOST_BENDS = 8
"""samples in a row at which straight lines bend: of more each is a sample of the signal's own"""
_FAST_SHARE, _FALLS = 0.005, 0.5
"""part of an input's power above a quarter of its rate, and its density there over that of the
octave below: an input with more of both moves between its samples"""
_LEVELS, _STEPS = 10, 20
"""distinct values and steps of a staircase at least: a commanded sequence of steps has fewer"""


class _Mode(NamedTuple):
    """A mode that shows in the record."""

    eigenvalue: complex
    input: str
    output: str

    @property
    def hz(self) -> float:
        """Its natural frequency."""
        return abs(self.eigenvalue) / (2.0 * np.pi)


def logging_rate(
    problem: Problem,
    flights: Sequence[tuple[str, Flight]],
    sd: Sequence[Mapping[str, Any]],
    params: Any = None,
) -> list[Finding]:
    """Rates of inputs and outputs against the fastest mode that matters.

    Args:
        problem: model and start values.
        flights: by what each is called.
        sd: by flight and output the noise that is assumed, SI.
        params: the model's Params with the estimates in place, SI; the start values unless given.
    """
    where = "start values" if params is None else "estimates"
    params = problem.start_params() if params is None else params
    findings: list[Finding] = []
    every: list[Finding] = []
    for (label, flight), noise in zip(flights, sd, strict=True):
        modes, hidden = _modes_that_show(problem, params, flight, _shown_from(flight, noise))
        if hidden:
            findings.append(_not_judged(label, hidden))
        of_flight = [
            *_of_inputs(label, flight, modes, where),
            *_of_outputs(label, flight, modes, where),
        ]
        findings += [f for f in of_flight if f.severity != "ok"]
        every += of_flight
    return findings if findings or not every else [min(every, key=_value)]


def loop_between_samples(
    flights: Sequence[tuple[str, Flight]], feedback: Sequence[Feedback]
) -> list[Finding]:
    """Doubts about inputs of a closed loop that act faster than they are logged.

    A controller that runs faster than the log moves its input between the samples, by what it saw
    of the response there. The power of such an input does not fall off before half of its rate.

    Args:
        flights: by what each is called.
        feedback: whether inputs follow the response.
    """
    followed = {(one.flight, one.input) for one in feedback if one.present}
    findings = []
    for label, flight in flights:
        for name, u in flight.inputs.items():
            # Held because somebody said so: then it is known between its samples.
            if (label, name) not in followed or name not in flight.hold_reason:
                continue
            rate = input_rate(flight, name, u)
            if rate is None:
                continue
            v = u[:: max(round(1.0 / (rate * flight.dt)), 1)]
            power = np.abs(np.fft.rfft(np.diff(v) * np.hanning(v.size - 1))) ** 2
            # Differences take off what is slow; the power itself is that over their gain.
            power = power[1:] / np.sin(0.5 * np.pi * np.arange(1, power.size) / power.size) ** 2
            quarter, half = power.size // 4, power.size // 2
            last, before = (float(np.mean(x)) for x in (power[half:], power[quarter:half]))
            share = float(np.sum(power[half:]) / np.sum(power))
            if not (share > _FAST_SHARE and last > _FALLS * before):
                continue
            words = (
                f"{label}: {name} closes a loop, and its power does not fall off before half of "
                f"its rate of {rate:.3g} Hz ({100 * share:.2g} % above a quarter): it moved "
                "between samples by what it saw of the response there, which biases the estimates. "
                "Log at the controller's rate and state hold: zero-order, or use an excitation "
                "(signals.instruments)."
            )
            criterion = f"part of the power above a quarter of the rate, {_FAST_SHARE:g}"
            brief = f"{name} moves between its samples in a closed loop"
            findings.append(
                Finding(
                    "timing.loop-between-samples",
                    "doubt",
                    words,
                    share,
                    criterion,
                    (name,),
                    brief=brief,
                )
            )
    return findings


def _value(finding: Finding) -> float:
    assert finding.value is not None
    return finding.value


def _shown_from(flight: Flight, noise: Mapping[str, Any]) -> dict[str, float]:
    """By output, by how much a mode has to move it to matter."""
    sizes = {}
    for name, y in flight.outputs.items():
        own = _PART * float(np.nanstd(y))
        sizes[name] = SHOWS * float(noise[name])
        # One that stays where it is shows no mode, however small its noise seems.
        if name not in flight.sd and own > 0:
            sizes[name] = min(sizes[name], own)
    return sizes


def _not_judged(label: str, hz: float) -> Finding:
    words = (
        f"{label}: whether the rate is enough was not judged: at the start values no mode of the "
        f"model (the fastest has {hz:.3g} Hz) moves an output by {SHOWS:g} times its noise."
    )
    return Finding(LOGGING_RATE, "doubt", words)


def _modes_that_show(
    problem: Problem, params: Any, flight: Flight, sizes: Mapping[str, float]
) -> tuple[list[_Mode], float]:
    """Those whose part in the answer to a step of an input's size stands out, and where there are
    only others the frequency [Hz] of their fastest, else 0."""
    known = {n: jnp.asarray(v) for n, v in flight.known.items()}
    params = naming.replace(params, **known)
    at = operating_point(
        problem.model, params, flight.inputs, flight.outputs, flight.dt, substeps=problem.substeps
    )
    modes = modes_about(problem, params, at)
    behind = states_behind(problem.model)
    machine = [n not in behind for n in naming.names(problem.model.State)]
    fastest = 0.0
    shown = []
    for k, eigenvalue in enumerate(modes.eigenvalues if modes is not None else ()):
        # Slower than the record is a drift, and a pair of integrators is no oscillation.
        if modes is None or abs(eigenvalue) < 2.0 * np.pi / (flight.n_samples * flight.dt):
            continue
        # A filter's own mode has no part in the machine. Its constants are known, and it is no
        # motion that a log would have to show.
        right = modes.right[:, k]
        if np.linalg.norm(right[machine]) < 1e-6 * np.linalg.norm(right):
            continue
        part, u, y = modes.strongest(k, problem, flight, sizes)
        fastest = max(fastest, abs(eigenvalue) / (2.0 * np.pi))
        if part >= 1.0:
            shown.append(_Mode(complex(eigenvalue), u, y))
    return shown, 0.0 if shown else fastest


def _of_inputs(label: str, flight: Flight, modes: list[_Mode], where: str) -> list[Finding]:
    findings = []
    for name, u in flight.inputs.items():
        rate = input_rate(flight, name, u)
        felt = [mode for mode in modes if mode.input == name]
        if rate is None or not felt:
            continue
        fastest = max(felt, key=lambda mode: mode.hz)
        ratio = rate / fastest.hz
        begun = (
            f"{label}: {name} was sampled at {rate:.3g} Hz while it moved, and {fastest.output} "
            f"answers up to {fastest.hz:.3g} Hz (a mode at the {where})"
        )
        finding = _judged(begun, ratio, fastest.hz)
        if finding.severity != "ok" and flight.hold[name] == "zero-order":
            # All stairs of one length are a clock's, and so is a test signal with a clock.
            finding = finding._replace(
                sentence=f"{finding.sentence} Where {name} was commanded in steps of that length, "
                "state hold: zero-order."
            )
        findings.append(finding)
    return findings


def _of_outputs(label: str, flight: Flight, modes: list[_Mode], where: str) -> list[Finding]:
    if not modes:
        return []
    # The fastest alone: what is too slow for it is said once.
    mode = max(modes, key=lambda m: m.hz)
    rate = max(output_rate(flight, y) for y in flight.outputs)
    # A decay has no alias, but between two samples all of it may be over.
    swings = abs(mode.eigenvalue.imag) > 0
    moves = "swings" if swings else "settles"
    begun = (
        f"{label}: outputs are logged at {rate:.3g} Hz, and {mode.output} {moves} at {mode.hz:.3g} "
        f"Hz (a mode at the {where})"
    )
    return [_judged(begun, rate / mode.hz, mode.hz, HOPELESS if swings else _SETTLED)]


def _judged(begun: str, ratio: float, hz: float, hopeless: float = HOPELESS) -> Finding:
    criterion = f"samples in a period of the fastest mode that shows, {ENOUGH:g} ({hopeless:g})"
    severity: Severity = "ok"
    ending = f": {number(ratio, 2)} samples in a period are enough."
    if ratio < hopeless:
        severity = "refuse"
        ending = (
            f": {number(ratio, 2)} samples in a period cannot show it, so this log cannot be "
            f"fitted with this model; log at {hopeless * hz:.3g} Hz at least, "
            f"better {ENOUGH * hz:.3g} Hz"
            f"{'; or its times are in ms (time.unit)' if ratio * hz <= _SLOW else ''}."
        )
    elif ratio < ENOUGH:
        severity = "doubt"
        ending = (
            f": {number(ratio, 2)} samples in a period hardly show it, and what happened "
            f"between them biases the estimates; log at {ENOUGH * hz:.3g} Hz."
        )
    return Finding(LOGGING_RATE, severity, f"{begun}{ending}", ratio, criterion)


def input_rate(flight: Flight, name: str, u: Float[np.ndarray, " N"]) -> float | None:
    """The rate [Hz] at which an input was sampled while it moved; None where it does not move, or
    is known between its samples because it was commanded in steps.

    Args:
        flight: says what the input does between samples, and who decided that.
        name: of the input.
        u: its samples.
    """
    if np.ptp(u) == 0:
        return None
    step = flight.logged_step(name, "input")
    # A slower topic's own clock is known, and its straight lines are those of the grid.
    slower = 1.0 / step if step > _SLOWER * flight.dt else None
    if flight.hold[name] != "zero-order":
        moving = split(u)[1] if flight.hold[name] == "mixed" else u
        return slower or _corner_rate(flight.dt, moving)
    # Held because somebody said so: then it is known at all times.
    if name not in flight.hold_reason:
        return None
    at = np.flatnonzero(np.diff(u) != 0)
    if at.size < _STEPS or np.unique(u).size < _LEVELS:
        return None
    # A slow clock's staircase: all stairs of one length but for the sample that rounding adds. What
    # a pilot or a generator commands in steps is held unequally.
    stairs = np.diff(at)
    usual = float(np.median(stairs))
    regular = np.mean(np.abs(stairs - usual) <= max(1.0, 0.05 * usual))
    if usual < 2 or regular < _REGULAR:
        return None
    return min(1.0 / (usual * flight.dt), slower or np.inf)


def _corner_rate(dt: float, u: np.ndarray) -> float:
    """The rate of the samples between which an input follows straight lines."""
    bends = np.abs(np.diff(u, 2))
    # Of most samples: a single absurd one would make the stick's own corners look like rounding.
    low, high = np.quantile(u, [0.01, 0.99])
    corners = np.flatnonzero(bends > 1e-6 * ((high - low) or np.ptp(u)))
    if corners.size < _STEPS:
        return 1.0 / dt
    # A corner between two samples of the new clock bends at both of them.
    begins = np.flatnonzero(np.diff(corners, prepend=-2) > 1)
    sizes = np.diff(begins, append=corners.size)
    if np.median(np.repeat(sizes, sizes)) > _MOST_BENDS:
        return 1.0 / dt
    within = np.arange(corners.size) - np.repeat(begins, sizes)
    steps = np.diff(corners[within % 2 == 0])
    # Where it rests there are no corners.
    return 1.0 / (float(np.mean(steps[steps <= 1.5 * np.median(steps)])) * dt)


def output_rate(flight: Flight, name: str) -> float:
    """The rate [Hz] of the samples of an output that are there."""
    seen = np.flatnonzero(np.isfinite(flight.outputs[name]))
    usual = float(np.median(np.diff(seen))) if seen.size > 1 else float(flight.n_samples)
    return 1.0 / max(usual * flight.dt, flight.logged_step(name, "output"))
