"""Windows of a record with the most information (Fisher) on the free parameters.

The record is cut into adjacent windows, each with its own initial state, as in multiple shooting;
with filter error a window is its part of the one filter. One Jacobian at the start values has the
rows of all windows. The windows that add most information are taken, one after another (Mehra,
1974).

A window begins in the state of the record's simulation at that instant. Its initial state and its
biases are free.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight, labels
from heli_jax.flights.parts import part
from heli_jax.flights.signal_facts import DROP_SHARE
from heli_jax.identification.design.accuracy import (
    expected_sd,
    together,
    triangle,
)
from heli_jax.identification.estimation.data import runs_away
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.simulated_flights import predict
from heli_jax.identification.identifiability.analysis import sensitivity_at, verdict_of
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Layout,
    Solution,
    flight_places,
    unpack,
)

ENOUGH = 0.9
"""D-efficiency of the windows that are taken: the q-th root of the determinant of their information
over that of all windows"""
_RAILS = 0.05
"""share of a window's samples at an end of a signal's range from which on it is left out"""
_GAP = 0.25
"""a gap: so many seconds without a sample of an output, and five of its usual steps"""
_PARTS = 12
"""windows in a record, unless their length is stated"""
_SHORTEST, _LONGEST = 2.0, 20.0
"""length of a window [s], unless it is stated"""
_PER_PARAMETER, _FEWEST = 3, 8
"""samples of a window for each free parameter, and in all, at least"""
_MOST = 200
"""windows; time and memory grow with the square of their number"""


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """One window of a flight."""

    flight: int
    """index among the fitted flights"""
    label: str
    first: int
    last: int
    """samples from `first` up to but not including `last`"""
    start: float
    end: float
    """[s] from the beginning of the log"""
    sd: Float[np.ndarray, " q"]
    """expected by this window alone, relative; inf where it does not determine a parameter"""
    excluded: str
    """reason why it is not used; empty if it may be"""


class Choice(NamedTuple):
    """A window that was taken."""

    window: Window
    efficiency: float
    """D-efficiency of all that are taken up to it"""
    sd: Float[np.ndarray, " q"]
    """expected by all that are taken up to it"""


@dataclasses.dataclass(frozen=True, eq=False)
class Ranking:
    """The windows of a record, and those that are taken."""

    parameters: tuple[str, ...]
    length: float
    """[s]"""
    windows: tuple[Window, ...]
    """in the order of time, excluded ones too"""
    taken: tuple[Choice, ...]
    """the most informative first"""
    all_sd: Float[np.ndarray, " q"]
    """expected by all windows that may be used"""
    undetermined: tuple[str, ...]
    """parameters that the whole record does not determine; their sd is inf"""
    guessed: tuple[str, ...]
    """flights and outputs whose noise was guessed"""
    noise: Mapping[str, float]
    """sd by `flight/output`, SI"""
    notes: tuple[Finding, ...] = ()
    """on sizes of gusts that nobody stated"""
    record: tuple[Finding, ...] = ()
    """doubts about the whole record, of `check`: rates and excitation"""


def window_samples(problem: Problem, length: float | None = None) -> int:
    """Return the samples of a window, a multiple of those of multiple shooting.

    Args:
        length: [s]; a twelfth of the longest flight unless given, between 2 s and 20 s.

    Raises:
        ValueError: no flight is as long, the window holds too few samples, or there are too many.
    """
    flight = max(problem.training, key=lambda f: f.duration)
    least = max(_FEWEST, _PER_PARAMETER * len(problem.free))
    fewest = max(least, -(-sum(f.n_samples for f in problem.training) // _MOST))
    if length is None:
        length = float(np.clip(flight.duration / _PARTS, _SHORTEST, _LONGEST))
        samples = min(max(round(length / flight.dt), fewest), flight.n_samples)
    else:
        samples = round(length / flight.dt)
        if samples > flight.n_samples:
            raise ValueError(
                f"windows of {length:g} s: expected at most the length of the longest flight, "
                f"{flight.n_samples * flight.dt:.4g} s"
            )
    if samples < min(fewest, flight.n_samples) or samples < least:
        raise ValueError(
            f"windows of {samples * flight.dt:.3g} s hold {samples} samples, expected {fewest} at "
            f"least: {least} for {len(problem.free)} free parameters, and at most {_MOST} windows"
        )
    if problem.window is not None:
        cell = round(problem.window / flight.dt)
        samples = min(max(1, round(samples / cell)) * cell, flight.n_samples)
    return samples


def rank_windows(
    problem: Problem, at: Solution, e: Evaluation, length: float | None = None
) -> Ranking:
    """Rank the windows of the fitted flights, and take those that reach the D-efficiency.

    Raises:
        ValueError: the length fits no flight, the simulation diverges, or no window may be used.
    """
    samples = window_samples(problem, length)
    every, flights = labels(problem.training), problem.training
    layout, shooting = at.layout, problem.window is not None
    for flight, run in zip(flights, e.simulated, strict=True):
        if away := [n for n, y in run.items() if runs_away(y, flight.outputs[n])]:
            raise ValueError(
                f"windows: the simulation of {', '.join(away)} diverges at the start values, "
                "expected fit.shooting or fit.method: filter-error"
            )
    lacking = verdict_of(problem, layout, e).not_identifiable
    if shooting:
        sizes = [m * max(1, round(samples / m)) for _, m in layout.windows]
    else:
        sizes = [-(-f.n_samples // max(1, round(f.n_samples / samples))) for f in flights]
        if layout.noise_model == "white":
            cut = tuple((-(-f.n_samples // m), m) for f, m in zip(flights, sizes, strict=True))
            layout = dataclasses.replace(layout, windows=cut, initial_state=True)
            e = evaluate(layout, at.data, at.noise, _window_states(layout, at))
    s = sensitivity_at(problem, layout, e)
    unknown = np.array([u.name in lacking for u in s.unknowns])
    number, _, sample, _ = layout.objective.tags(layout, at.data, len(s.shared))
    windows = []
    for i, (flight, size) in enumerate(zip(flights, sizes, strict=True)):
        later = 0.0 if flight.source is None else flight.t0 - flight.source.first_time
        # A rest of less than half a window is none.
        for first in range(0, max(flight.n_samples - size // 2, 1), size):
            last = min(first + size, flight.n_samples)
            T = triangle(s.part((number == i) & (sample >= first) & (sample < last)))
            sd = np.where(unknown, np.inf, expected_sd(s.unknowns, T))
            start, end = later + first * flight.dt, later + (last - 1) * flight.dt
            excluded = why_excluded(flight, first, last)
            windows.append((Window(i, every[i], first, last, start, end, sd, excluded), T))
    usable = [one for one in windows if not one[0].excluded]
    if not usable:
        excluded = windows[0][0].excluded
        raise ValueError(f"no window of {samples} samples may be used: {excluded}")
    taken, all_sd = _take_windows(s.unknowns, usable, unknown)
    sds = list(zip(every, flights, at.noise.sd, strict=True))
    return Ranking(
        tuple(u.name for u in s.unknowns),
        samples * flights[0].dt,
        tuple(window for window, _ in windows),
        taken,
        all_sd,
        tuple(u.name for u in s.unknowns if u.name in lacking),
        tuple(f"{label}/{n}" for label, f, sd in sds for n in sd if n not in f.sd),
        {f"{label}/{n}": float(v) for label, _, sd in sds for n, v in sd.items()},
    )


def why_excluded(flight: Flight, first: int, last: int) -> str:
    """Return the reason why a window of a flight is not used; empty if it may be."""
    for name, y in flight.outputs.items():
        seen = np.flatnonzero(np.isfinite(y))
        here = seen[(seen >= first) & (seen < last)]
        longest = float(np.max(np.diff(np.r_[first - 1, here, last])))
        if longest > max(5.0 * float(np.median(np.diff(seen))), _GAP / flight.dt):
            return f"{name} has a gap of {longest * flight.dt:.2g} s"
    for (name, _), whole in flight.facts.items():
        facts = whole.within(first * flight.dt, (last - 1) * flight.dt)
        if facts.stuck is not None:
            return f"{name} is stuck"
        if facts.dropped >= DROP_SHARE and facts.dropouts is not None:
            return f"{name} has dropouts"
        if sum(facts.shares) >= _RAILS:
            return f"{name} is clipped"
    return ""


def _window_states(layout: Layout, at: Solution) -> Float[Array, " q"]:
    """Return the unknowns with each window's initial state from the simulation of the record."""
    z, every = np.asarray(at.z), naming.names(layout.model.State)
    own, of_states = [z[: layout.first_nuisance]], [every.index(n) for n in layout.states]
    runs = eqx.filter_jit(predict)(at.layout, at.data, unpack(at.layout, at.data, at.z))
    each = zip(at.data.flights, runs, layout.windows, flight_places(at.layout), strict=True)
    for flight, run, (count, m), places in each:
        scales = np.array([float(flight.state_scale[n]) for n in layout.states])
        begun = np.asarray(run.states)[of_states][:, m * np.arange(count)]
        own += [(begun.T / scales).ravel(), z[places.constants]]
    return jnp.asarray(np.concatenate(own), at.z.dtype)


def _take_windows(
    unknowns: tuple[Unknown, ...],
    usable: list[tuple[Window, np.ndarray]],
    unknown: Float[np.ndarray, " q"],
) -> tuple[tuple[Choice, ...], Float[np.ndarray, " q"]]:
    """Return the windows in order of their gain until they reach the D-efficiency, and the sds
    expected by all."""
    left, R, taken = list(usable), np.zeros((0, usable[0][1].shape[1])), []
    sd, log_dets = np.full(len(unknowns), np.inf), []
    while left:
        gains = [_log_det(unknowns, together(R, T)) for _, T in left]
        window, T = left.pop(int(np.argmax(gains)))
        R = together(R, T)
        sd = np.where(unknown, np.inf, expected_sd(unknowns, R))
        taken.append(Choice(window, 0.0, sd))
        log_dets.append(max(gains))
    efficiencies = np.exp((np.array(log_dets) - log_dets[-1]) / len(unknowns))
    taken = [c._replace(efficiency=float(f)) for c, f in zip(taken, efficiencies, strict=True)]
    return tuple(taken[: 1 + int(np.argmax(efficiencies >= ENOUGH))]), sd


def _log_det(unknowns: tuple[Unknown, ...], R: np.ndarray) -> float:
    """Return the log determinant of the information on the parameters of interest."""
    q = len(unknowns)
    # Weak information on all, so that the determinant is not zero.
    weak = np.diag([max(u.prior, 1.0 / u.scale) for u in unknowns] + [0.1] * (R.shape[1] - q))
    whole = np.linalg.qr(np.vstack([R, weak]), mode="r")
    # With the parameters last, the corner of the factor has the others eliminated.
    whole = np.linalg.qr(np.hstack([whole[:, q:], whole[:, :q]]), mode="r")
    corner = np.abs(np.diag(whole)[R.shape[1] - q :])
    return 2.0 * float(np.sum(np.log(np.maximum(corner, 1e-300))))


def window_flights(problem: Problem, ranking: Ranking) -> dict[int, tuple[Flight, ...]]:
    """Return, by the number of a fitted flight, its taken windows as flights, in order of time."""
    flights: dict[int, list[Flight]] = {}
    for choice in sorted(ranking.taken, key=lambda c: (c.window.flight, c.window.first)):
        w = choice.window
        whole = problem.training[w.flight]
        name = f"{whole.name or w.label} {w.start:.4g}-{w.end:.4g} s"
        taken = found(
            "windows.chosen",
            "note",
            value=ranking.taken[-1].efficiency,
            begin=w.start,
            end=w.end,
            count=len(ranking.taken),
            length=ranking.length,
        )
        flights.setdefault(w.flight, []).append(part(whole, w.first, w.last, name, taken))
    return {i: tuple(f) for i, f in flights.items()}
