"""Which windows of a record say most of the free parameters, by Fisher's information.

The record is cut into windows with initial states of their own, twice, the second time half a
window later; the model at the start values is driven through all of them side by side by the logged
inputs, and one Jacobian tells what each says. From these a set without overlap is taken, each time
the window that gains most (greedy choice; the D-criterion: Mehra, 1974).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax.flights.cut import part
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.estimator import Evaluation, signal_numbers
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.identifiability.expected import (
    Sensitivity,
    expected_sd,
    sensitivity_at,
    together,
    triangle,
)
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import start_vector
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, layout_of
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation.usable_windows import Exclusions

ENOUGH = 0.9
"""D-efficiency of the windows that are taken: the q-th root of the determinant of their information
over that of all windows, about the part of all that is known of a parameter"""
_PARTS = 12
"""windows in a record, unless their length is stated"""
_SHORTEST, _LONGEST = 2.0, 20.0
"""length of a window [s], unless it is stated"""
_PER_PARAMETER = 3
"""samples of a window for each free parameter, at least (`Problem` asks that of a flight)"""
_FEWEST = 8
"""samples of a window, at least"""
_ROUNDING = 1e-12


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """One window of a flight."""

    flight: int
    """its number among the flights that are fitted"""
    label: str
    first: int
    last: int
    """samples from `first` up to but not including `last`"""
    start: float
    end: float
    """[s] from the beginning of the log, as `window` of a configuration counts; of a flight that is
    from no log from its own"""
    sd: Float[np.ndarray, " q"]
    """expected by this window alone, relative; inf where it does not determine a parameter"""
    excluded: str = ""
    """why it is not to be used"""

    def overlaps(self, other: "Window") -> bool:
        """Whether both have samples in common."""
        return self.flight == other.flight and self.first < other.last and other.first < self.last


class Choice(NamedTuple):
    """A window that was taken."""

    window: Window
    efficiency: float
    """D-efficiency of all that are taken up to it"""
    sd: Float[np.ndarray, " q"]
    """expected by all that are taken up to it"""
    reason: str


@dataclasses.dataclass(frozen=True, eq=False)
class Ranking:
    """What the windows of a record say."""

    parameters: tuple[str, ...]
    length: float
    """[s]"""
    windows: tuple[Window, ...]
    """in the order of time, those that are excluded too"""
    taken: tuple[Choice, ...]
    """the most telling first"""
    all_sd: Float[np.ndarray, " q"]
    """expected by all windows that may be used, without overlap"""


def window_samples(problem: Problem, length: float | None = None) -> int:
    """The samples of a window.

    Args:
        problem: its flights, and the windows of multiple shooting, of which a window holds whole
            ones.
        length: [s]; a twelfth of the longest flight unless given, between 2 s and 20 s.

    Raises:
        ValueError: no flight is as long, or the window holds too few samples.
    """
    flight = max(problem.training, key=lambda f: f.duration)
    least = max(_FEWEST, _PER_PARAMETER * len(problem.free))
    if length is None:
        samples = round(np.clip(flight.duration / _PARTS, _SHORTEST, _LONGEST) / flight.dt)
        samples = min(max(samples, least), flight.n_samples)
    else:
        samples = round(length / flight.dt)
        if samples > flight.n_samples:
            raise ValueError(
                f"windows of {length:g} s: expected at most the length of the longest flight, "
                f"{flight.n_samples * flight.dt:.4g} s"
            )
    if samples < least:
        raise ValueError(
            f"windows of {samples * flight.dt:.3g} s hold {samples} samples, expected {least} at "
            f"least for {len(problem.free)} free parameters"
        )
    if problem.window is not None:
        cell = round(problem.window / flight.dt)
        samples = max(1, round(samples / cell)) * cell
    return min(samples, flight.n_samples)


def rank_windows(
    problem: Problem, at: Solution, e: Evaluation, length: float | None = None
) -> Ranking:
    """What each window of the flights that are fitted says, and those that together say enough.

    Args:
        problem: what is free.
        at: layout, data, noise and unknowns at the start values.
        e: the evaluation there.
        length: of a window [s].

    Raises:
        ValueError: the length fits no flight, or no window may be used.
    """
    samples = window_samples(problem, length)
    if at.layout.estimator.rows_are_samples:
        s, spans = _simulated(problem, at, samples)
    else:
        s, spans = _filtered(problem, at, e, samples)
    windows, triangles = [], []
    reasons = Exclusions(problem.training)
    for span, rows in spans:
        excluded, T = reasons.of(*span), np.zeros((s.shared.shape[1],) * 2)
        if np.isfinite(s.shared[rows]).all() and np.isfinite(s.own[rows]).all():
            T = triangle(s, rows)
        else:
            excluded = excluded or "the simulation at the start values diverges"
        windows.append(_window(problem, span, expected_sd(s.unknowns, T), excluded))
        triangles.append(T)
    order = sorted(range(len(windows)), key=lambda k: (windows[k].flight, windows[k].first))
    windows, triangles = [windows[k] for k in order], [triangles[k] for k in order]
    usable = [k for k, w in enumerate(windows) if not w.excluded]
    if not usable:
        raise ValueError(f"no window of {samples} samples may be used: {windows[0].excluded}")
    taken, total = _greedy(s.unknowns, windows, triangles, usable)
    names = tuple(u.name for u in s.unknowns)
    dt = problem.training[0].dt
    return Ranking(names, samples * dt, tuple(windows), taken, expected_sd(s.unknowns, total))


class _Span(NamedTuple):
    flight: int
    first: int
    last: int


def _window(problem: Problem, span: _Span, sd: np.ndarray, excluded: str) -> Window:
    flight = problem.training[span.flight]
    label = labels(problem.training)[span.flight]
    # A flight is later than its log where it is a part of it, or where a topic begins late.
    later = 0.0 if flight.source is None else flight.t0 - flight.source.first_time
    start, end = later + span.first * flight.dt, later + (span.last - 1) * flight.dt
    return Window(span.flight, label, span.first, span.last, start, end, sd, excluded)


def _simulated(
    problem: Problem, at: Solution, samples: int
) -> tuple[Sensitivity, list[tuple[_Span, np.ndarray]]]:
    """The rows of all windows, each simulated from an initial state of its own."""
    cell = (
        samples
        if problem.window is None
        else min(round(problem.window / problem.training[0].dt), samples)
    )
    cuts = _cuts(problem.training, samples, cell)
    flights = tuple(part(problem.training[i], first, last) for i, first, last in cuts)
    layout = dataclasses.replace(
        layout_of(problem, flights),
        windows=tuple(((last - first) // cell, cell) for _, first, last in cuts),
        continuity=None,
        initial_state=True,
    )
    data = at.data._replace(flights=tuple(_numbers(at.data, *cut) for cut in cuts))
    noise = Noise(tuple(at.noise.sd[i] for i, _, _ in cuts), at.noise.log_variance_ratio)
    z = start_vector(layout, data, problem)
    z = jnp.concatenate([at.z[: at.layout.first_nuisance], z[layout.first_nuisance :]])
    e = evaluate(layout, data, noise, z)
    # What diverges is left out window by window.
    if problem.model.linear and np.isfinite(e.J).all():
        z = _best_states(layout, e, z)
        e = evaluate(layout, data, noise, z)
    s = sensitivity_at(problem, layout, e)
    return s, _rows_of_spans(layout, data, cuts, samples, cell)


def _cuts(flights: Sequence[Flight], samples: int, cell: int) -> list[tuple[int, int, int]]:
    """Parts (flight, first, last) of whole cells that together hold every window: from the
    beginning, half a window later, and the end."""
    cuts = []
    for i, flight in enumerate(flights):
        n = flight.n_samples
        for first in dict.fromkeys((0, samples // 2 if samples == cell else 0)):
            count = (n - first) // cell
            if count * cell >= samples:
                cuts.append((i, first, first + count * cell))
        if n >= samples and n % cell:
            cuts.append((i, n - samples, n))
    return cuts


def _numbers(data: Data, i: int, first: int, last: int) -> Any:
    """The i-th flight's numbers, cut."""
    flight = data.flights[i]
    inputs, outputs = jax.tree.map(lambda v: v[first:last], (flight.inputs, flight.outputs))
    return flight._replace(inputs=inputs, outputs=outputs)


def _best_states(layout: Layout, e: Evaluation, z: jax.Array) -> jax.Array:
    """z with the initial states and biases that explain the outputs best at these parameters: of a
    linear model one step of least squares."""
    # How the machine moves at a window's beginning is part of what its samples tell.
    first, J = layout.first_nuisance, np.asarray(e.J, np.float64)
    step = np.linalg.lstsq(J[:, first:], -np.asarray(e.r, np.float64), rcond=_ROUNDING)[0]
    return z.at[first:].add(jnp.asarray(step, z.dtype))


def _rows_of_spans(
    layout: Layout, data: Data, cuts: list[tuple[int, int, int]], samples: int, cell: int
) -> list[tuple[_Span, np.ndarray]]:
    """Windows of whole cells, and the rows of each."""
    flight, k = _places(layout, data)
    # Half a window on where windows hold several cells; of one cell the second cut is.
    step, spans = max(samples // cell // 2, 1) * cell, {}
    for c, (i, first, last) in enumerate(cuts):
        for begin in range(0, last - first - samples + 1, step):
            rows = np.flatnonzero((flight == c) & (k >= begin) & (k < begin + samples))
            # Two cuts may hold the same window.
            spans.setdefault(_Span(i, first + begin, first + begin + samples), rows)
    return list(spans.items())


def _places(layout: Layout, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Of every measured number its flight and its sample's number."""
    numbers = signal_numbers(layout, data)
    flights = [i for i, names in enumerate(layout.outputs) for _ in names]
    begins = np.searchsorted(numbers, np.arange(len(flights)))
    return np.array(flights)[numbers], np.arange(numbers.size) - begins[numbers]


def _filtered(
    problem: Problem, at: Solution, e: Evaluation, samples: int
) -> tuple[Sensitivity, list[tuple[_Span, np.ndarray]]]:
    """The rows of a filter over the whole record, by window: a filter forgets how it began."""
    s = sensitivity_at(problem, at.layout, e)
    flight, k = _places(at.layout, at.data)
    # As many rows again, the last ones, are of the variances.
    more = len(s.shared) - flight.size
    spans = []
    for i, f in enumerate(problem.training):
        begins = list(range(0, f.n_samples - samples + 1, max(samples // 2, 1)))
        for begin in dict.fromkeys([*begins, max(f.n_samples - samples, 0)]):
            if begin + samples > f.n_samples:
                continue
            rows = np.flatnonzero((flight == i) & (k >= begin) & (k < begin + samples))
            if more >= flight.size:
                rows = np.concatenate([rows, rows + more])
            spans.append((_Span(i, begin, begin + samples), rows))
    return s, spans


def _greedy(
    unknowns: tuple[Unknown, ...],
    windows: list[Window],
    triangles: list[np.ndarray],
    usable: list[int],
) -> tuple[tuple[Choice, ...], np.ndarray]:
    """Windows without overlap, the one that gains most first, until they say enough."""
    size = triangles[0].shape[0]
    begin = np.zeros((size, size))
    order, left, R = [], list(usable), begin
    steps = []
    while left:
        # The first of equal ones: the same record gives the same windows.
        gains = [_log_det(unknowns, together(R, triangles[k])) for k in left]
        best = left[int(np.argmax(gains))]
        R = together(R, triangles[best])
        order.append(best)
        steps.append((R, max(gains)))
        left = [k for k in left if not windows[k].overlaps(windows[best])]
    q, total = len(unknowns), steps[-1][1]
    taken, sd = [], np.full(q, np.inf)
    for k, (R, log_det) in zip(order, steps, strict=True):
        efficiency = float(np.exp((log_det - total) / q))
        after = expected_sd(unknowns, R)
        taken.append(Choice(windows[k], efficiency, after, _reason(unknowns, sd, after)))
        sd = after
        if efficiency >= ENOUGH:
            break
    return tuple(taken), steps[-1][0]


def _log_det(unknowns: tuple[Unknown, ...], R: np.ndarray) -> float:
    """Logarithm of the determinant of what is known of the parameters of interest."""
    q = len(unknowns)
    # What nothing tells yet has the sd of its interval or of a factor of e, so that the determinant
    # is never zero; of the noise's own unknowns, which are eliminated, that is an sd of ten.
    weak = np.diag([max(u.prior, 1.0 / u.scale) for u in unknowns] + [0.1] * (len(R) - q))
    whole = np.linalg.qr(np.vstack([R, weak]), mode="r")
    # With the parameters last their corner of the triangle is what is left without the others.
    whole = np.linalg.qr(np.hstack([whole[:, q:], whole[:, :q]]), mode="r")
    corner = np.abs(np.diag(whole)[len(R) - q :])
    return 2.0 * float(np.sum(np.log(np.maximum(corner, 1e-300))))


def _reason(unknowns: tuple[Unknown, ...], before: np.ndarray, after: np.ndarray) -> str:
    """Of which parameter a window told most."""
    with np.errstate(invalid="ignore", divide="ignore"):
        fall = np.where(np.isfinite(after), np.log(before / after), 0.0)
    fall = np.nan_to_num(fall, nan=0.0, posinf=np.inf)
    i = int(np.argmax(fall))
    if not np.isfinite(after[i]):
        return "determines no parameter by itself"
    if not np.isfinite(before[i]):
        new = [u.name for u, f in zip(unknowns, fall, strict=True) if np.isinf(f)]
        return f"determines {', '.join(new)}"
    return f"{unknowns[i].name}: sd {100 * before[i]:.2g} % to {100 * after[i]:.2g} %"


def window_flights(problem: Problem, ranking: Ranking) -> dict[int, tuple[Flight, ...]]:
    """By the number of a fitted flight the windows that were taken of it, as flights, in the order
    of time."""
    flights: dict[int, list[Flight]] = {}
    for choice in sorted(ranking.taken, key=lambda c: (c.window.flight, c.window.first)):
        w = choice.window
        whole = problem.training[w.flight]
        note = (
            f"window: auto took {w.start:.4g} s to {w.end:.4g} s of it ({choice.reason}; "
            f"{len(ranking.taken)} windows of {ranking.length:.3g} s say "
            f"{100 * ranking.taken[-1].efficiency:.0f} % of what all say)"
        )
        name = f"{whole.name or w.label} {w.start:.4g}-{w.end:.4g} s"
        flights.setdefault(w.flight, []).append(part(whole, w.first, w.last, name, note))
    return {i: tuple(f) for i, f in flights.items()}
