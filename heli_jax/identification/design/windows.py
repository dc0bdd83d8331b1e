"""Which windows of a record say most of the free parameters, by Fisher's information.

The record is cut into windows with initial states of their own, twice, the second time half a
window later; the model at the start values is driven through all of them side by side by the logged
inputs, each from where the whole record's simulation is, and one Jacobian tells what each says.
From these a set without overlap is taken.

A part must not say more than the whole. With an initial state, biases and offsets that fit its
samples best a window would move more than the record does at the start values, and with weak priors
of its own it would know more. So a window begins where the record's simulation is at that instant,
and its share of the weak priors is its share of the samples.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.flights.parts import part
from heli_jax.flights.signal_facts import DROP_SHARE
from heli_jax.identification.design.accuracy import (
    FREE,
    Sensitivity,
    expected_sd,
    not_determined,
    sensitivity_at,
    together,
    triangle,
)
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.simulated_flights import predict
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels, start_vector
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    flight_places,
    layout_of,
    unpack,
)

ENOUGH = 0.9
"""D-efficiency of the windows that are taken: the q-th root of the determinant of their information
over that of all windows, about the part of all that is known of a parameter"""
DETERMINES = 1.0
"""relative sd below which a parameter counts as determined: a factor of e either way"""
_RAILS = 0.05
"""part of a window's samples at an end of a signal's range, from which on it is left out"""
_GAP = 0.25
"""seconds without a sample of an output, and five of its usual steps, that are a gap"""
_DIVERGED = 10.0
"""times the measured range, beyond which the simulation of the whole record says nothing of where a
window begins"""
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


def why_excluded(flight: Flight, first: int, last: int) -> str:
    """Return in words why a window of a flight is not to be used; empty where it may be.

    Args:
        flight: the whole of it.
    """
    for name, y in flight.outputs.items():
        if missing := _missing(y, slice(first, last), flight.dt):
            return f"{name}: {missing}"
    for (name, _), whole in flight.facts.items():
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
        """True if both have samples in common."""
        return self.flight == other.flight and self.first < other.last and other.first < self.last


class Choice(NamedTuple):
    """A window that was taken."""

    window: Window
    efficiency: float
    """D-efficiency of all that are taken up to it"""
    sd: Float[np.ndarray, " q"]
    """expected by all that are taken up to it"""
    reason: str


def _chosen(
    unknowns: tuple[Unknown, ...],
    usable: list[tuple[Window, np.ndarray]],
    unknown: Float[np.ndarray, " q"],
) -> tuple[tuple[Choice, ...], Float[np.ndarray, " q"]]:
    """Windows without overlap, the one that gains most first, until they say enough (Mehra, 1974),
    and the sds expected of all that could be taken.

    Args:
        unknown: True where the whole record does not determine a parameter.
    """

    def sd_of(R: np.ndarray) -> np.ndarray:
        return np.where(unknown, np.inf, expected_sd(unknowns, R))

    left, R, steps = usable, np.zeros_like(usable[0][1]), []
    while left:
        # The first of equal ones: the same record gives the same windows.
        gains = [_log_det(unknowns, together(R, T)) for _, T in left]
        window, T = left[int(np.argmax(gains))]
        R = together(R, T)
        steps.append((window, R, max(gains)))
        left = [one for one in left if not one[0].overlaps(window)]
    taken, sd = [], np.full(len(unknowns), np.inf)
    for window, R, log_det in steps:
        efficiency, after = float(np.exp((log_det - steps[-1][2]) / len(unknowns))), sd_of(R)
        taken.append(Choice(window, efficiency, after, _reason(unknowns, sd, after)))
        sd = after
        if efficiency >= ENOUGH:
            break
    return tuple(taken), sd_of(steps[-1][1])


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
    """The parameter of which a window tells most."""
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


@dataclasses.dataclass(frozen=True, eq=False)
class Ranking:
    """The windows of a record, and those that are taken."""

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
    """Return the samples of a window.

    Args:
        problem: its flights, and the windows of multiple shooting, of which a window holds whole
            ones.
        length: [s]; a twelfth of the longest flight unless given, between 2 s and 20 s.

    Raises:
        ValueError: no flight is as long, the window holds too few samples, or there are too many.
    """
    flight = max(problem.training, key=lambda f: f.duration)
    least = max(_FEWEST, _PER_PARAMETER * len(problem.free))
    fewest = -(-2 * sum(f.n_samples for f in problem.training) // _MOST)
    if length is None:
        samples = round(np.clip(flight.duration / _PARTS, _SHORTEST, _LONGEST) / flight.dt)
        samples = min(max(samples, least, fewest), flight.n_samples)
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
    if length is not None and samples < fewest:
        count = sum(2 * f.n_samples // samples for f in problem.training)
        raise ValueError(
            f"windows of {length:g} s: expected at most {_MOST} windows, got {count}, half "
            f"overlapping; {fewest * flight.dt:.3g} s is the shortest length for this log"
        )
    if problem.window is not None:
        cell = round(problem.window / flight.dt)
        samples = max(1, round(samples / cell)) * cell
    return min(samples, flight.n_samples)


def rank_windows(
    problem: Problem, at: Solution, e: Evaluation, length: float | None = None
) -> Ranking:
    """Rank the windows of the flights that are fitted, and take those that together say enough.

    Args:
        length: of a window [s].

    Raises:
        ValueError: the length fits no flight, or no window may be used.
    """
    if at.layout.noise_model == "spectrum":
        raise ValueError(
            f"windows: method {problem.method} has no rows in time to rank them by, expected "
            "output-error or filter-error"
        )
    samples = window_samples(problem, length)
    if at.layout.noise_model == "white":
        s, spans, notes = _simulated(problem, at, e, samples)
    else:
        s, spans, notes = *_filtered(problem, at, e, samples), ()
    # Of a record that diverges nothing is known, and its windows stand for themselves.
    lacking = not_determined(problem, at.layout, e) if np.isfinite(e.J).all() else ()
    unknown = np.array([u.name in lacking for u in s.unknowns])
    every, windows = labels(problem.training), []
    for (i, first, last), rows in spans.items():
        flight, own = problem.training[i], s.part(rows)
        excluded, T = why_excluded(flight, first, last), np.zeros((s.shared.shape[1],) * 2)
        if np.isfinite(own.shared).all() and np.isfinite(own.own).all():
            T = triangle(own)
        else:
            excluded = excluded or "the simulation at the start values diverges"
        sd = np.where(unknown, np.inf, expected_sd(s.unknowns, T))
        start, end = _times(flight, first, last)
        windows.append((Window(i, every[i], first, last, start, end, sd, excluded), T))
    windows.sort(key=lambda one: (one[0].flight, one[0].first))
    usable = [one for one in windows if not one[0].excluded]
    if not usable:
        excluded = windows[0][0].excluded
        raise ValueError(f"no window of {samples} samples may be used: {excluded}")
    taken, all_sd = _chosen(s.unknowns, usable, unknown)
    noise, guessed = {}, []
    for label, flight, sd in zip(every, problem.training, at.noise.sd, strict=True):
        noise |= {f"{label}/{n}": float(v) for n, v in sd.items()}
        guessed += [f"{label}/{n}" for n in sd if n not in flight.sd]
    return Ranking(
        tuple(u.name for u in s.unknowns),
        samples * problem.training[0].dt,
        tuple(window for window, _ in windows),
        taken,
        all_sd,
        lacking,
        tuple(guessed),
        noise,
        notes,
    )


def _times(flight: Flight, first: int, last: int) -> tuple[float, float]:
    """When a window begins and ends [s] from the beginning of the log."""
    # A flight is later than its log where it is a part of it, or where a topic begins late.
    later = 0.0 if flight.source is None else flight.t0 - flight.source.first_time
    return later + first * flight.dt, later + (last - 1) * flight.dt


class _Span(NamedTuple):
    """Samples of a flight, `last` not included."""

    flight: int
    first: int
    last: int


def _simulated(
    problem: Problem, at: Solution, e: Evaluation, samples: int
) -> tuple[Sensitivity, dict[_Span, np.ndarray], tuple[Finding, ...]]:
    """The rows of all windows, each simulated from an initial state of its own, and what is to be
    said of these."""
    length, shooting = problem.window, problem.window is not None
    cell = samples if length is None else min(round(length / problem.training[0].dt), samples)
    cuts = _cuts(problem.training, samples, cell)
    layout = dataclasses.replace(
        layout_of(problem, tuple(part(problem.training[c.flight], c.first, c.last) for c in cuts)),
        windows=tuple(((last - first) // cell, cell) for _, first, last in cuts),
        continuity=None,
        initial_state=True,
    )
    numbers = []
    for i, first, last in cuts:
        flight, cut = at.data.flights[i], slice(first, last)
        inputs, outputs = jax.tree.map(lambda v, cut=cut: v[cut], (flight.inputs, flight.outputs))
        numbers.append(flight._replace(inputs=inputs, outputs=outputs))
    data = at.data._replace(flights=tuple(numbers))
    noise = Noise(tuple(at.noise.sd[c.flight] for c in cuts), at.noise.log_variance_ratio)
    begin, notes = layout.first_nuisance, ()
    states = None if shooting else _states_of_record(at, e)
    if states is not None:
        own = jnp.asarray(_on_record(layout, data, cuts, at, states), at.z.dtype)
    else:
        own = start_vector(layout, data, problem)[begin:]
    z = jnp.concatenate([at.z[:begin], own])
    here = evaluate(layout, data, noise, z)
    if states is None and not shooting:
        notes = (found("windows.own-beginnings", "note"),)
        # What diverges is left out window by window.
        if problem.model.linear and np.isfinite(here.J).all():
            # The states and biases that explain the outputs best at these parameters.
            J, r = np.asarray(here.J, np.float64)[:, begin:], np.asarray(here.r, np.float64)
            step = np.linalg.lstsq(J, -r, rcond=_ROUNDING)[0]
            here = evaluate(layout, data, noise, z.at[begin:].add(jnp.asarray(step, z.dtype)))
    s = sensitivity_at(problem, layout, here)
    weights = _prior_weights(layout, cuts, problem.training, samples, shooting=shooting)
    s = s._replace(own=s.own / weights)
    flight, _, k, _ = layout.objective.tags(layout, data, len(s.shared))
    # Half a window on where windows hold several cells; of one cell the second cut is.
    step, spans = max(samples // cell // 2, 1) * cell, {}
    for c, (i, first, last) in enumerate(cuts):
        for begin in range(0, last - first - samples + 1, step):
            rows = np.flatnonzero((flight == c) & (k >= begin) & (k < begin + samples))
            # Two cuts may hold the same window.
            spans.setdefault(_Span(i, first + begin, first + begin + samples), rows)
    return s, spans, notes


def _cuts(flights: tuple[Flight, ...], samples: int, cell: int) -> list[_Span]:
    """Parts of whole cells that together hold every window: from the beginning, half a window
    later, and the end."""
    cuts = []
    for i, flight in enumerate(flights):
        n = flight.n_samples
        for first in dict.fromkeys((0, samples // 2 if samples == cell else 0)):
            count = (n - first) // cell
            if count * cell >= samples:
                cuts.append(_Span(i, first, first + count * cell))
        # An end of a few samples more makes no other window.
        if n >= samples and n % cell > _ANOTHER * samples:
            cuts.append(_Span(i, n - samples, n))
    return cuts


def _states_of_record(at: Solution, e: Evaluation) -> tuple[np.ndarray, ...] | None:
    """By flight the simulated states (s, N) of the record; None where its simulation diverges."""
    for run, flight in zip(e.simulated, at.data.flights, strict=True):
        for name, y in run.items():
            size = float(np.nanmax(np.abs(np.asarray(flight.outputs[name]))))
            if not np.max(np.abs(y)) <= _DIVERGED * max(size, 1e-300):
                return None
    states = tuple(np.asarray(x) for x in jax.device_get(_states(at.layout, at.data, at.z)))
    return states if all(np.isfinite(x).all() for x in states) else None


@eqx.filter_jit
def _states(layout: Layout, data: Data, z: Float[Array, " q"]) -> tuple[Array, ...]:
    return tuple(run.states for run in predict(layout, data, unpack(layout, data, z)))


def _on_record(
    layout: Layout,
    data: Data,
    cuts: list[_Span],
    at: Solution,
    states: tuple[np.ndarray, ...],
) -> list[float]:
    """The own unknowns of all windows: states from the whole record's simulation, biases and
    offsets those of the record."""
    every, record, values = naming.names(layout.model.State), flight_places(at.layout), []
    z = np.asarray(at.z)
    for cut, (count, m), flight in zip(cuts, layout.windows, data.flights, strict=True):
        for k in range(count):
            x = states[cut.flight][:, cut.first + k * m]
            values += [float(x[every.index(n)] / flight.state_scale[n]) for n in layout.states]
        values += z[record[cut.flight].constants].tolist()
    return values


def _prior_weights(
    layout: Layout,
    cuts: list[_Span],
    flights: tuple[Flight, ...],
    samples: int,
    *,
    shooting: bool,
) -> Float[np.ndarray, " k"]:
    """By own unknown of all windows, the part of its weak prior (as 1 / sd) that a window has.

    Args:
        flights: the whole ones.
        shooting: True if the whole record has initial states at every window too.
    """
    weights: list[float] = []
    for cut, places in zip(cuts, flight_places(layout), strict=True):
        for k, states in enumerate(places.states):
            # In the whole record the state has a prior at its beginning alone.
            stated = cut.first == 0 and (k == 0 or shooting)
            weights += [1.0 if stated else FREE] * states.size
        weights += [_share(samples, flights[cut.flight])] * places.constants.size
    return np.array(weights)


def _share(samples: int, flight: Flight) -> float:
    """The part that a window has of the weak prior of a bias, of which the record has one."""
    return min(samples / flight.n_samples, 1.0) ** 0.5


def _filtered(
    problem: Problem, at: Solution, e: Evaluation, samples: int
) -> tuple[Sensitivity, dict[_Span, np.ndarray]]:
    """The rows of a filter over the whole record, by window: a filter forgets how it began."""
    s = sensitivity_at(problem, at.layout, e)
    flight, _, k, _ = at.layout.objective.tags(at.layout, at.data, len(s.shared))
    own, spans = s.own.copy(), {}
    for i, f in enumerate(problem.training):
        own[flight == i] /= _share(samples, f)
        begins = range(0, f.n_samples - samples + 1, max(samples // 2, 1))
        for begin in dict.fromkeys([*begins, f.n_samples - samples]):
            if begin >= 0:
                rows = np.flatnonzero((flight == i) & (k >= begin) & (k < begin + samples))
                spans[_Span(i, begin, begin + samples)] = rows
    return s._replace(own=own), spans


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
            reason=choice.reason,
            count=len(ranking.taken),
            length=ranking.length,
        )
        flights.setdefault(w.flight, []).append(part(whole, w.first, w.last, name, taken))
    return {i: tuple(f) for i, f in flights.items()}
