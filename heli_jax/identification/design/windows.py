"""Which windows of a record say most of the free parameters, by Fisher's information.

The record is cut into windows with initial states of their own, twice, the second time half a
window later; the model at the start values is driven through all of them side by side by the logged
inputs, each from where the whole record's simulation is, and one Jacobian tells what each says.
From these a set without overlap is taken.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.finding import Finding, found
from heli_jax.flights.cut import part
from heli_jax.flights.flight import Flight
from heli_jax.flights.signal_facts import DROP_SHARE
from heli_jax.identification.design.accuracy import (
    Sensitivity,
    expected_sd,
    sensitivity_at,
    together,
    triangle,
)
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.simulated_flights import predict, signal_numbers
from heli_jax.identification.identifiability.sensitivity import verdict_of
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels, start_vector
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, layout_of, unpack

# Why a window of a record is not to be used: gaps, missing samples, signals at their ends.


_RAILS = 0.05
"""part of a window's samples at an end of a signal's range, from which on it is left out"""
_GAP = 0.25
"""seconds without a sample of an output, and five of its usual steps, that are a gap"""


class Exclusions:
    """Why a window of a flight is not to be used."""

    def __init__(self, flights: tuple[Flight, ...]) -> None:
        self.flights = flights
        self.facts = [f.facts for f in flights]

    def of(self, i: int, first: int, last: int) -> str:
        """In words; empty where it may be used.

        Args:
            i: number of the flight.
            first: sample.
            last: sample after the window's last one.
        """
        inside = slice(first, last)
        flight = self.flights[i]
        for name, y in flight.outputs.items():
            if missing := _missing(y, inside, flight.dt):
                return f"{name}: {missing}"
        for (name, _), whole in self.facts[i].items():
            facts = whole.within(first * flight.dt, (last - 1) * flight.dt)
            if facts.stuck is not None:
                length = sum(one.end - one.begin for one in facts.stretches)
                return f"{name} stuck at one value for {length:.2g} s"
            if facts.dropped >= DROP_SHARE and facts.dropouts is not None:
                words = f"jumps to {facts.dropouts.value:.4g} and back"
                return f"{name} {words}, in {100 * facts.dropped:.2g} % of the samples"
            share = sum(facts.shares)
            if share >= _RAILS:
                return f"{name} at an end of its range in {100 * share:.0f} % of the samples"
        return ""


def _missing(y: np.ndarray, inside: slice, dt: float) -> str:
    """What is missing of an output within a window, in words."""
    seen = np.flatnonzero(np.isfinite(y))
    # A sensor slower than the flight's rate leaves samples out that are no gap.
    usual = float(np.median(np.diff(seen))) if seen.size > 1 else 1.0
    here = np.flatnonzero(np.isfinite(y[inside]))
    n = inside.stop - inside.start
    if here.size < 2:
        return "no samples"
    longest = float(np.max(np.diff(np.concatenate([[-1], here, [n]]))))
    if longest > 5.0 * usual and longest * dt > _GAP:
        return f"a gap of {longest * dt:.2g} s"
    if here.size < 0.5 * n / usual:
        return f"{100 * (1 - here.size * usual / n):.0f} % of the samples missing"
    return ""


# Where the windows of a record begin, so that none says more than the record it is cut from.
#
# A window has an initial state, biases and offsets of its own. With states and offsets that fit its
# samples best it would move more than the record does at the start values, and with weak priors of
# its own it would know more: both would let a part say more than the whole. So a window begins
# where the record's own simulation is at that instant, and its share of what the weak priors say is
# its share of the samples.


_DIVERGED = 10.0
"""times the measured range, beyond which the simulation of the whole record says nothing of where a
window begins"""
_FREE = 1e-3
"""weight of the weak prior of a state that the whole record has none for: next to nothing, and no
direction without any information, which would be rounding"""


def states_of_record(at: Solution, e: Evaluation) -> tuple[np.ndarray, ...] | None:
    """By flight the simulated states (s, N); None where the simulation diverges.

    Args:
        at: layout, data and unknowns of the whole record.
        e: the evaluation there.
    """
    for run, flight in zip(e.simulated, at.data.flights, strict=True):
        for name, y in run.items():
            size = float(np.nanmax(np.abs(np.asarray(flight.outputs[name]))))
            if not np.isfinite(y).all() or np.max(np.abs(y)) > _DIVERGED * max(size, 1e-300):
                return None
    states = tuple(np.asarray(x) for x in jax.device_get(_states(at.layout, at.data, at.z)))
    return states if all(np.isfinite(x).all() for x in states) else None


@eqx.filter_jit
def _states(layout: Layout, data: Data, z: Float[Array, " q"]) -> tuple[Array, ...]:
    return tuple(run.states for run in predict(layout, data, unpack(layout, data, z)))


def begins_on_record(
    layout: Layout,
    data: Data,
    cuts: Sequence[tuple[int, int, int]],
    at: Solution,
    states: tuple[np.ndarray, ...],
) -> Float[Array, " k"]:
    """The nuisances of all windows: states from the whole record's simulation, biases and offsets
    those of the record.

    Args:
        layout: of the windows.
        data: of the windows.
        cuts: (flight, first, last) of each of the layout's flights.
        at: the whole record.
        states: of `states_of_record`.
    """
    every = naming.names(layout.model.State)
    values: list[float] = []
    for c, (i, first, _) in enumerate(cuts):
        count, m = layout.windows[c]
        scale = data.flights[c].state_scale
        for k in range(count):
            x = states[i][:, first + k * m]
            values += [float(x[every.index(n)]) / float(scale[n]) for n in layout.states]
        values += [float(v) for v in _constants(at, i)]
    return jnp.asarray(values, at.z.dtype)


def _constants(at: Solution, i: int) -> np.ndarray:
    """Biases and offsets of the i-th flight of the whole record."""
    position = at.layout.first_nuisance
    for j in range(i + 1):
        position += at.layout.windows[j][0] * len(at.layout.states)
        position += at.layout.constants(at.layout.outputs[j])
    return np.asarray(at.z)[position - at.layout.constants(at.layout.outputs[i]) : position]


def prior_weights(
    layout: Layout,
    cuts: Sequence[tuple[int, int, int]],
    sizes: Sequence[int],
    samples: int,
    *,
    shooting: bool,
) -> Float[np.ndarray, " k"]:
    """By nuisance of all windows, the part of its weak prior (as 1 / sd) that a window has.

    Args:
        layout: of the windows.
        cuts: (flight, first, last) of each of the layout's flights.
        sizes: samples of each whole flight.
        samples: of a window.
        shooting: whether the whole record has initial states at every window too.
    """
    weights: list[float] = []
    for c, (i, first, _) in enumerate(cuts):
        count, _ = layout.windows[c]
        for k in range(count):
            # In the whole record the state has a prior at its beginning alone.
            stated = first == 0 and (k == 0 or shooting)
            weights += [1.0 if stated else _FREE] * len(layout.states)
        # All windows together have one prior of a bias, as the whole record has.
        share = min(samples / sizes[i], 1.0) ** 0.5
        weights += [share] * layout.constants(layout.outputs[c])
    return np.array(weights)


# The windows without overlap that together say most: greedy choice by the D-criterion.


ENOUGH = 0.9
"""D-efficiency of the windows that are taken: the q-th root of the determinant of their information
over that of all windows, about the part of all that is known of a parameter"""
DETERMINES = 1.0
"""relative sd below which a parameter counts as determined: a factor of e either way"""


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
    """[s] from the beginning of the flight"""
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


def chosen(
    unknowns: tuple[Unknown, ...],
    windows: list[Window],
    triangles: list[np.ndarray],
    usable: list[int],
    unknown: np.ndarray,
) -> tuple[tuple[Choice, ...], np.ndarray]:
    """Windows without overlap, the one that gains most first, until they say enough (Mehra, 1974),
    and the triangle of all that could be taken.

    Args:
        unknowns: the parameters.
        windows: all of them.
        triangles: what each says.
        usable: the numbers of those that may be taken.
        unknown: (q,) whether the whole record does not determine a parameter.
    """
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
        after = np.where(unknown, np.inf, expected_sd(unknowns, R))
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
    known, new = after < DETERMINES, (after < DETERMINES) & (before >= DETERMINES)
    if not known.any():
        return "determines no parameter by itself"
    if new.any():
        return f"determines {', '.join(u.name for u, n in zip(unknowns, new, strict=True) if n)}"
    i = int(np.argmax(fall))
    return f"{unknowns[i].name}: sd {100 * before[i]:.2g} % to {100 * after[i]:.2g} %"


_PARTS = 12
"""windows in a record, unless their length is stated"""
_SHORTEST, _LONGEST = 2.0, 20.0
"""length of a window [s], unless it is stated"""
_PER_PARAMETER = 3
"""samples of a window for each free parameter, at least (`Problem` asks that of a flight)"""
_FEWEST = 8
"""samples of a window, at least"""
_MOST = 200
"""windows: each has unknowns of its own, so that time and memory grow with their square"""
_ROUNDING = 1e-12
_ANOTHER = 0.02
"""of a window: how far the one at the end has to lie from that before it"""


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
    undetermined: tuple[str, ...] = ()
    """parameters that the whole record does not determine, as `check` says; their sd is inf"""
    guessed: tuple[str, ...] = ()
    """flights and outputs whose noise was guessed, and is that of `noise`"""
    noise: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """sd by `flight/output`, SI"""
    notes: tuple[Finding, ...] = ()
    """on how the windows were compared"""
    record: tuple[Finding, ...] = ()
    """what speaks against the whole record, as `check` says it: rates, and what inputs excite"""


def window_samples(problem: Problem, length: float | None = None) -> int:
    """The samples of a window.

    Args:
        problem: its flights, and the windows of multiple shooting, of which a window holds whole
            ones.
        length: [s]; a twelfth of the longest flight unless given, between 2 s and 20 s.

    Raises:
        ValueError: no flight is as long, the window holds too few samples, or there are too many.
    """
    flight = max(problem.training, key=lambda f: f.duration)
    least = max(_FEWEST, _PER_PARAMETER * len(problem.free))
    if length is None:
        samples = round(np.clip(flight.duration / _PARTS, _SHORTEST, _LONGEST) / flight.dt)
        samples = min(max(samples, least, _fewest(problem)), flight.n_samples)
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
    if length is not None and samples < _fewest(problem):
        count = sum(2 * f.n_samples // samples for f in problem.training)
        raise ValueError(
            f"windows of {length:g} s: expected at most {_MOST} windows, got {count}, half "
            f"overlapping; {_fewest(problem) * flight.dt:.3g} s is the shortest length for this log"
        )
    if problem.window is not None:
        cell = round(problem.window / flight.dt)
        samples = max(1, round(samples / cell)) * cell
    return min(samples, flight.n_samples)


def _fewest(problem: Problem) -> int:
    """Samples of a window of which there are not too many."""
    return -(-2 * sum(f.n_samples for f in problem.training) // _MOST)


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
    if at.layout.estimator.noise_spectrum:
        raise ValueError(
            f"windows: method {problem.method} has no rows in time to rank them by, expected "
            "output-error or filter-error"
        )
    samples = window_samples(problem, length)
    if at.layout.estimator.rows_are_samples:
        s, spans, notes = _simulated(problem, at, e, samples)
    else:
        s, spans, notes = *_filtered(problem, at, e, samples), ()
    undetermined = _undetermined(problem, at.layout, e)
    unknown = np.array([u.name in undetermined for u in s.unknowns])
    windows, triangles = [], []
    reasons = Exclusions(problem.training)
    for span, rows in spans:
        excluded, T = reasons.of(*span), np.zeros((s.shared.shape[1],) * 2)
        if np.isfinite(s.shared[rows]).all() and np.isfinite(s.own[rows]).all():
            T = triangle(s, rows)
        else:
            excluded = excluded or "the simulation at the start values diverges"
        sd = np.where(unknown, np.inf, expected_sd(s.unknowns, T))
        windows.append(_window(problem, span, sd, excluded))
        triangles.append(T)
    order = sorted(range(len(windows)), key=lambda k: (windows[k].flight, windows[k].first))
    windows, triangles = [windows[k] for k in order], [triangles[k] for k in order]
    usable = [k for k, w in enumerate(windows) if not w.excluded]
    if not usable:
        raise ValueError(f"no window of {samples} samples may be used: {windows[0].excluded}")
    taken, total = chosen(s.unknowns, windows, triangles, usable, unknown)
    names, every = tuple(u.name for u in s.unknowns), labels(problem.training)
    sds = {
        f"{i}/{n}": float(v)
        for i, sd in zip(every, at.noise.sd, strict=True)
        for n, v in sd.items()
    }
    stated = {f"{i}/{n}" for i, f in zip(every, problem.training, strict=True) for n in f.sd}
    return Ranking(
        names,
        samples * problem.training[0].dt,
        tuple(windows),
        taken,
        np.where(unknown, np.inf, expected_sd(s.unknowns, total)),
        undetermined,
        tuple(n for n in sds if n not in stated),
        sds,
        notes,
    )


def _undetermined(problem: Problem, layout: Layout, e: Evaluation) -> tuple[str, ...]:
    """What the whole record does not determine: then none of its parts does."""
    # Of one that diverges nothing is known, and its windows stand for themselves.
    if not np.isfinite(e.J).all():
        return ()
    verdict = verdict_of(problem, layout, e)
    return (*verdict.undetermined, *verdict.without_effect)


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
    problem: Problem, at: Solution, e: Evaluation, samples: int
) -> tuple[Sensitivity, list[tuple[_Span, np.ndarray]], tuple[Finding, ...]]:
    """The rows of all windows, each simulated from an initial state of its own, and what is to be
    said of these."""
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
    nuisances, notes = start_vector(layout, data, problem)[layout.first_nuisance :], ()
    states = states_of_record(at, e) if problem.window is None else None
    if states is not None:
        nuisances = begins_on_record(layout, data, cuts, at, states)
    z = jnp.concatenate([at.z[: at.layout.first_nuisance], nuisances])
    here = evaluate(layout, data, noise, z)
    if states is None and problem.window is None:
        notes = (found("windows.own-beginnings", "note"),)
        # What diverges is left out window by window.
        if problem.model.linear and np.isfinite(here.J).all():
            here = evaluate(layout, data, noise, _best_states(layout, here, z))
    s = sensitivity_at(problem, layout, here)
    sizes = [f.n_samples for f in problem.training]
    weights = prior_weights(layout, cuts, sizes, samples, shooting=problem.window is not None)
    s = s._replace(own=s.own / weights)
    return s, _rows_of_spans(layout, data, cuts, samples, cell), notes


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
        # An end of a few samples more makes no other window.
        if n >= samples and n % cell > _ANOTHER * samples:
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
    of_rows = np.concatenate([flight, flight]) if more >= flight.size else flight
    own, spans = s.own.copy(), []
    for i, f in enumerate(problem.training):
        begins = list(range(0, f.n_samples - samples + 1, max(samples // 2, 1)))
        # All windows together have one weak prior of a bias, as the whole record has.
        own[np.flatnonzero(of_rows == i)] /= min(samples / f.n_samples, 1.0) ** 0.5
        for begin in dict.fromkeys([*begins, max(f.n_samples - samples, 0)]):
            if begin + samples > f.n_samples:
                continue
            rows = np.flatnonzero((flight == i) & (k >= begin) & (k < begin + samples))
            if more >= flight.size:
                rows = np.concatenate([rows, rows + more])
            spans.append((_Span(i, begin, begin + samples), rows))
    return s._replace(own=own), spans


def window_flights(problem: Problem, ranking: Ranking) -> dict[int, tuple[Flight, ...]]:
    """By the number of a fitted flight the windows that were taken of it, as flights, in the order
    of time."""
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
            reason=choice.reason,
            count=len(ranking.taken),
            length=ranking.length,
        )
        flights.setdefault(w.flight, []).append(part(whole, w.first, w.last, name, taken))
    return {i: tuple(f) for i, f in flights.items()}
