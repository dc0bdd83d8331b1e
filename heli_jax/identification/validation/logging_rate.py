"""Sampling rates of a log against the modes of the model, at the start values or the estimates.

Outputs that are sampled at less than twice a mode's frequency show its aliases. An input is known
only at its samples: of a motion at f, straight lines between them miss the part
(pi f / rate)^2 / 3, a staircase pi f / rate. At a rate of 2 f the samples show nothing of the
motion; at 5 f straight lines miss a seventh.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.onboard.filters import states_behind
from heli_jax.flights.flight import Flight
from heli_jax.identification.identifiability.equivalents import Modes, modes_of, relative_slopes
from heli_jax.identification.problem import Problem
from heli_jax.numerics.white_noise import white_part


@dataclass(frozen=True)
class _Limits:
    hopeless: float = 2.0
    """Samples per period below which a mode is not visible."""
    settled: float = 1.0
    """The same for a mode that does not oscillate, whose period is 2 pi time constants."""
    enough: float = 5.0
    """Samples per period from which on a mode is visible."""
    shows: float = 3.0
    """Least motion of an output over its noise for a mode to matter."""
    part: float = 0.1
    """The same over the output's motion, since the noise guessed from slow samples is too large."""
    regular: float = 0.8
    """Least share of a staircase's steps with the usual length, for a slow clock."""
    slower: float = 1.05
    """Sample interval over the grid's, from which on a signal is slower than the grid."""
    levels: int = 10
    """Fewest distinct values of a staircase; commanded steps have fewer."""
    steps: int = 20
    """Fewest steps of a staircase."""
    fast_share: float = 0.005
    """Share of an input's power above a quarter of its rate, for motion between its samples."""
    falls: float = 0.5
    """Least power density there over that of the octave below, likewise."""


RATE = _Limits()


# The step response of an integrator is infinite.
@np.errstate(divide="ignore", invalid="ignore")
def _strongest(
    modes: Modes, k: int, problem: Problem, flight: Flight, noise: Mapping[str, Any]
) -> tuple[float, str, str]:
    """Return the largest part of mode k in an output's step response, with input and output.

    The step has the input's size; the part is relative to the output's noise (sd, SI). If no input
    moves, the part is that of the free motion, relative to the most visible mode.
    """
    outputs = naming.names(problem.model.Outputs)
    best = (0.0, "", "")
    if not any(np.ptp(u) > 0 for u in flight.inputs.values()):
        for y in flight.outputs:
            shown = np.abs(modes.C[outputs.index(y)] @ modes.right)
            shown *= np.linalg.norm(modes.left, axis=1)
            part = shown[k] / max(float(shown.max()), 1e-300)
            best = max(best, (part * np.nanstd(flight.outputs[y]) / float(noise[y]), "", y))
        return best
    for j, u in enumerate(naming.names(problem.model.Inputs)):
        size = float(np.std(flight.inputs[u])) / abs(modes.eigenvalues[k])
        for y in flight.outputs:
            residue = abs(modes.C[outputs.index(y)] @ modes.right[:, k])
            residue *= abs(modes.left[k] @ modes.B[:, j])
            best = max(best, (residue * size / float(noise[y]), u, y))
    return best


# Rates against the visible modes.


class _Mode(NamedTuple):
    """Mode that is visible in the record."""

    hz: float
    """Natural frequency [Hz]."""
    swings: bool
    input: str
    output: str


class Rate(NamedTuple):
    """Rate of signals, and the fastest mode that they must show."""

    signals: tuple[str, ...]
    hz: float
    mode: _Mode
    least: float
    """Samples per period below which the mode is not visible."""
    may_be_steps: bool = False
    """True for an input that may have been commanded in steps of equal length."""

    @property
    def samples(self) -> float:
        """Samples in a period of the mode."""
        return self.hz / self.mode.hz


def rates_against_modes(
    problem: Problem, params: Any, flight: Flight, noise: Mapping[str, Any]
) -> list[Rate]:
    """Return the rates of moving inputs, and of outputs, against the fastest mode that matters.

    The list is empty if no mode matters. Params and the noise's sd by output are in SI.
    """
    modes = sorted(_modes_that_show(problem, params, flight, noise))
    if not modes:
        return []
    rates = []
    for name, u in flight.inputs.items():
        rate = input_rate(flight, name, u)
        driven = [mode for mode in modes if mode.input == name]
        if rate is not None and driven:
            own_clock = flight.logged_step(name, "input") > RATE.slower * flight.dt
            staircase = flight.hold[name] == "zero-order" and not own_clock
            steps = staircase and _jumps_at_random(u)
            rates.append(Rate((name,), rate, driven[-1], RATE.hopeless, steps))
    of = {y: output_rate(flight, y) for y in flight.outputs}
    fastest = max(of.values())
    # A decay has no alias, but it may end between two samples.
    least = RATE.hopeless if modes[-1].swings else RATE.settled
    outputs = tuple(y for y in of if of[y] == fastest)
    return [*rates, Rate(outputs, fastest, modes[-1], least)]


def _modes_that_show(
    problem: Problem, params: Any, flight: Flight, noise: Mapping[str, Any]
) -> Iterator[_Mode]:
    """Yield the modes that are visible in the response to a step of an input's size."""
    sizes = {}
    for name, y in flight.outputs.items():
        own = RATE.part * float(np.nanstd(y))
        sizes[name] = RATE.shows * float(noise[name])
        if name not in flight.sd and own > 0:
            sizes[name] = min(sizes[name], own)
    known = {n: jnp.asarray(v) for n, v in flight.known.items()}
    modes = modes_of(problem, naming.replace(params, **known), flight)
    behind = states_behind(problem.model)
    vehicle = [n not in behind for n in naming.names(problem.model.State)]
    for k, eigenvalue in enumerate(modes.eigenvalues if modes is not None else ()):
        # A mode slower than the record is a drift.
        if modes is None or abs(eigenvalue) < 2.0 * np.pi / (flight.n_samples * flight.dt):
            continue
        # A mode of a filter alone is known: leave it out.
        right = modes.right[:, k]
        if np.linalg.norm(right[vehicle]) < 1e-6 * np.linalg.norm(right):
            continue
        part, u, y = _strongest(modes, k, problem, flight, sizes)
        if part >= 1.0:
            yield _Mode(abs(eigenvalue) / (2.0 * np.pi), abs(eigenvalue.imag) > 0, u, y)


def input_rate(flight: Flight, name: str, u: Float[np.ndarray, " N"]) -> float | None:
    """Return the rate [Hz] at which a moving input was sampled.

    None if it does not move, or if it is known between its samples since it was commanded in steps.
    """
    if np.ptp(u) == 0:
        return None
    step = flight.logged_step(name, "input")
    # The clock of a slower signal is known; the grid interpolates it by straight lines.
    slower = 1.0 / step if step > RATE.slower * flight.dt else None
    if flight.hold[name] != "zero-order":
        return slower or 1.0 / flight.dt
    # With a hold that the user stated the input is known at all times.
    if name not in flight.hold_reason:
        return None
    at = np.flatnonzero(np.diff(u) != 0)
    if at.size < RATE.steps or np.unique(u).size < RATE.levels:
        return None
    # All steps of a slow clock's staircase have the same length, up to rounding.
    stairs = np.diff(at)
    usual = float(np.median(stairs))
    regular = np.mean(np.abs(stairs - usual) <= max(1.0, 0.05 * usual))
    if usual < 2 or regular < RATE.regular:
        return None
    return min(1.0 / (usual * flight.dt), slower or np.inf)


_RELATED = 0.5
"""Correlation of neighbouring levels above which a staircase is a slow log."""


def _jumps_at_random(u: Float[np.ndarray, " N"]) -> bool:
    """True if the levels of a staircase hardly depend on the level before.

    A slow log of a moving stick has steps from level to neighbouring level.
    """
    levels = u[np.flatnonzero(np.diff(u, prepend=np.nan) != 0)]
    return bool(np.var(np.diff(levels)) > 2.0 * (1.0 - _RELATED) * np.var(levels))


def output_rate(flight: Flight, name: str) -> float:
    """Return the rate [Hz] of an output's measured samples."""
    seen = np.flatnonzero(np.isfinite(flight.outputs[name]))
    usual = float(np.median(np.diff(seen))) if seen.size > 1 else float(flight.n_samples)
    return 1.0 / max(usual * flight.dt, flight.logged_step(name, "output"))


def power_between_samples(flight: Flight, name: str) -> tuple[float, float] | None:
    """Return the rate [Hz] of an input, and the share of its power above a quarter of that rate.

    None if the power falls off before half of the rate. A controller that runs faster than the log
    moves its input between the samples.
    """
    u = flight.inputs[name]
    # With a hold that the user stated the input is known between its samples.
    rate = input_rate(flight, name, u) if name in flight.hold_reason else None
    if rate is None:
        return None
    v = u[:: max(round(1.0 / (rate * flight.dt)), 1)]
    power = np.abs(np.fft.rfft(np.diff(v) * np.hanning(v.size - 1))) ** 2
    # Differences remove slow drift; dividing by their gain restores the power.
    power = power[1:] / np.sin(0.5 * np.pi * np.arange(1, power.size) / power.size) ** 2
    quarter, half = power.size // 4, power.size // 2
    last, before = (float(np.mean(x)) for x in (power[half:], power[quarter:half]))
    share = float(np.sum(power[half:]) / np.sum(power))
    return (rate, share) if share > RATE.fast_share and last > RATE.falls * before else None


# Modes past the Nyquist frequency, and the free parameters that move them.
#
# Samples at a rate f do not distinguish w + 2 pi f from w. A mode past the Nyquist frequency
# therefore has aliases that fit equally well, each with a narrow interval.


_NEAR = 0.8
"""Share of the Nyquist frequency from which on an alias of a mode fits equally well."""
_TURNED = 0.2
"""Least relative change of the frequency over that of a parameter that can move it to an alias.

The ratio is 0.5 if the frequency goes with the parameter's square root."""
_SWINGS = 10.0
"""Frequency over decay, above which a mode oscillates even if it decays within a sample."""


def measurement_noise(
    problem: Problem, sd: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, float], ...]:
    """Return by flight and output the noise's sd, without the errors of the model."""
    # The residuals of a wrong optimum exceed the noise and would hide its fast mode.
    return tuple(
        {n: max(min(float(s), white_part(flight.outputs[n])), 1e-300) for n, s in one.items()}
        for flight, one in zip(problem.training, sd, strict=True)
    )


def aliased_parameters(
    problem: Problem, values: Mapping[str, float], noise: Sequence[Mapping[str, Any]]
) -> frozenset[str]:
    """Return the free parameters that can move a visible mode to an alias past Nyquist.

    Args:
        values: values of the free parameters [SI]; gains and shifts among them move no mode.
        noise: sd by flight and output [SI].
    """
    aliased = set[str]()
    for flight, sd in zip(problem.training, noise, strict=True):
        here = {**{n: v for n, v in values.items() if n in problem.free}, **flight.known}
        modes = modes_of(problem, problem.params_with(here), flight)
        if modes is None:
            continue
        # Only the imaginary part counts: a fast decay without oscillation has no alias.
        swing, decay = np.imag(modes.eigenvalues), -np.real(modes.eigenvalues)
        past = swing >= _NEAR * np.pi / flight.dt
        # A mode that decays within a sample has no visible alias, unless it oscillates many times.
        past &= (decay * flight.dt < 1.0) | (swing > decay * _SWINGS)
        lost = [
            k
            for k in np.flatnonzero(past).tolist()
            if _strongest(modes, k, problem, flight, sd)[0] >= RATE.shows
        ]
        if not lost:
            continue
        # A prior excludes the alias; the modes of a delay are those of its approximation.
        names = [
            n
            for n in here
            if n not in flight.known
            and problem.free[n].prior is None
            and n not in problem.model.delay_parameters
        ]
        slopes = relative_slopes(problem, here, names, modes)
        aliased |= {n for n, s in slopes.items() if np.any(np.abs(np.imag(s[lost])) > _TURNED)}
    return frozenset(aliased)
