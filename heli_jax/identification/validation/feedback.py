"""Whether inputs follow the response: feedback, by a pilot or a controller.

Innovations are what a record's own past cannot foretell of its outputs, nor its inputs until the
output is measured: the residuals of a multivariable ARX model of the record itself, so that a poor
model of the machine is no alarm. The inputs until then in parts of a sample: an output that answers
to how a stick moved within a sample would else pass for news, which the stick then goes on from.
Under feedback an input depends on past innovations (L. Ljung, System Identification, 2nd ed. 1999,
13.4 and 16.5); without it, it does not. Each input is freed of what its own past foretells, and the
rest is correlated with sums of past innovations. The variance of such a correlation between two
autocorrelated signals is Bartlett's: the sum over all lags of the product of both autocorrelations
(L. D. Haugh, J. Am. Stat. Assoc. 71, 1976).

An input that is logged late follows the response as well, though nobody closes a loop: no such
correlation tells the two apart. Where a delay was estimated and is negative, the input is taken so
much earlier; elsewhere a late log is named as the other reading.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.dynamics.model import axes_of
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation.arx_residuals import Past, arx_residuals
from heli_jax.identification.validation.lag_blocks import correlations_with_sums, lag_blocks
from heli_jax.numbers import percent

STEPS = "inputs stay where they are between jumps"
"""the reason why nothing is tested where no input moves freely"""
LEVEL = 0.01
"""of the test of a whole record: all inputs, outputs and lags together"""
_RATE = 50.0
"""samples a second at most: no feedback that a machine flies by is faster than a quarter of that"""
_SLOW_RATE = 10.0
"""samples a second at which slow feedback, as a pilot's, shows through a sensor's noise"""
_PARTS = 5
"""of a sample at a lower rate, at most, into which the inputs within it are taken apart"""
_LONGEST = 2.0
"""lag up to which an input may follow [s]"""
_MOST = 20_000
"""samples that are looked at"""
_LEAST = 200
"""samples of a record to be tested"""
_JUMP, _ROUNDS = 5.0, 3
"""times the median size of what is unforeseen of an input, above which it is a jump; how often what
is left is looked at again"""
_MOVES = 0.05
"""part of the samples at which an input that may follow something moves, at least"""
_LONG_REST, _AT_REST = 20, 0.5
"""samples of one value in a row that are a rest between two motions, and the part of a record that
such rests take in one whose input was programmed"""
_STILL = 1e-4
"""of the range of an input, below which a difference is no motion"""
_SEEN = 0.8
"""part of the samples of an output that is used"""


class Feedback(NamedTuple):
    """What was found of one input of one flight. The names of the fields are keys of fit.json."""

    flight: str
    input: str
    output: str
    """whose past innovations it follows most surely"""
    correlation: float
    """of the unforeseen part of the input with them"""
    lag: tuple[float, float]
    """[s] how long ago they were"""
    p_value: float
    """for all inputs, outputs and lags of the record that were tested"""
    earlier: float = 0.0
    """[s] how much earlier than logged the input was taken, as its estimated delay says"""
    delay_known: bool = False
    """whether its delay was estimated: else the input may also be logged late"""

    @property
    def present(self) -> bool:
        """Whether the input follows the response."""
        return self.p_value < LEVEL


def feedback(
    flight: Flight, together: int = 1, earlier: Mapping[str, float] | None = None
) -> tuple[Feedback, ...]:
    """By input that moves freely, whether it follows past innovations; nothing where the record is
    too short to tell.

    Args:
        flight: inputs and outputs as measured; no model is asked.
        together: how many flights are tested side by side, for the p values.
        earlier: by input, how much earlier than logged it is to be taken [s]; none unless given.
    """
    tested = [_tested(flight, earlier or {}, rate) for rate in _rates(flight)]
    each = [one for one in tested if not isinstance(one, str)]
    label, found = flight.name or "flight 1", {}
    for one in each:
        for name in one.free:
            made = _dependence(one, name, together * len(each))
            late = one.steps.get(name, 0) * flight.dt
            now = made._replace(flight=label, earlier=late)
            before = found.get(name, now)
            found[name] = min(before, now, key=lambda f: (f.p_value, f.correlation))
    return tuple(found.values())


def _rates(flight: Flight) -> tuple[float, ...]:
    """Samples a second at which a flight is looked at."""
    # No faster than the inputs come, nor than half of the log: when a frame of a stick began within
    # a sample, and how it moved there, is not known, and an output that answers to it would pass
    # for news.
    frames = min([0.5, *map(_frames, flight.inputs.values())]) / flight.dt
    fast = float(np.clip(frames, _SLOW_RATE, _RATE))
    return (fast, _SLOW_RATE) if fast > _SLOW_RATE else (fast,)


def _frames(u: np.ndarray) -> float:
    """How often an input has a new value while it moves, of its samples."""
    at = np.flatnonzero(np.diff(u) != 0.0)
    return 1.0 / float(np.median(np.diff(at))) if at.size > 1 else np.inf


def _dependence(tested: "_Tested", name: str, together: int) -> Feedback:
    """Of one input the past innovations that it follows most surely."""
    blocks = lag_blocks(max(1, min(round(_LONGEST / tested.dt), len(tested.innovations) // 10)))
    # Bonferroni: one test in a hundred records fails by chance, not one in a hundred lags.
    tests = together * len(tested.inputs) * len(tested.outputs) * len(blocks)
    each = correlations_with_sums(tested.free[name], tested.innovations, blocks)
    # Of several that are sure beyond all numbers the correlation decides.
    k, b = min(
        np.ndindex(each.p_value.shape), key=lambda at: (each.p_value[at], each.correlation[at])
    )
    p, correlation = float(each.p_value[k, b]), float(each.correlation[k, b])
    lag = (blocks[b][0] * tested.dt, blocks[b][1] * tested.dt)
    return Feedback("", name, tested.outputs[k], correlation, lag, min(1.0, tests * p))


class _Tested(NamedTuple):
    """What is correlated."""

    free: dict[str, np.ndarray]
    """by input what its own past does not foretell"""
    innovations: Float[np.ndarray, "N p"]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    steps: dict[str, int]
    """by input by how many samples of the flight it was taken earlier"""
    dt: float


def _tested(flight: Flight, earlier: Mapping[str, float], rate: float) -> _Tested | str:
    """What of a flight is correlated at so many samples a second [Hz] at most, or in words why
    nothing is."""
    # Half of a record at most: a delay beyond is none that it could show.
    most = flight.n_samples // 2
    steps = {n: min(math.ceil(s / flight.dt - 1e-9), most) for n, s in earlier.items()}
    inputs, outputs, parts, dt = _decimated(flight, steps, rate)
    if not outputs:
        most = percent(1 - _SEEN, 0)
        return f"every output stays where it is or lacks more than {most} of its samples"
    n = next(iter(outputs.values())).size
    if n < _LEAST:
        return f"the record is too short ({n * dt:.3g} s, expected {_LEAST * dt:.3g} s at least)"
    unforeseen = {name: _unforeseen(values) for name, values in inputs.items()}
    free = {name: values for name, values in unforeseen.items() if values is not None}
    if not free:
        return STEPS
    y = np.stack(list(outputs.values()), axis=1)
    # From all signals together. What one output alone cannot foretell may well be the answer to an
    # input, and would pass for feedback. A sample's own inputs stand beside the outputs before it.
    u = np.concatenate([parts[1:], parts[-1:]])
    innovations = arx_residuals(y, np.concatenate([y, u], axis=1))
    if innovations is None:
        return "too few samples stand in a row without a missing one"
    return _Tested(free, innovations, tuple(inputs), tuple(outputs), steps, dt)


def why_untested(problem: Problem) -> str:
    """Why nothing was tested of any flight, in words; `STEPS` where inputs move in no other way."""
    reasons = {
        label: tested
        for label, f in zip(labels(problem.training), problem.training, strict=True)
        if isinstance(tested := _tested(f, {}, _rates(f)[0]), str)
    }
    kinds = list(dict.fromkeys(reasons.values()))
    if len(kinds) < 2:
        return "".join(kinds)
    return "; ".join(f"{label}: {reason}" for label, reason in reasons.items())


def feedback_of(
    problem: Problem, delays: Mapping[str, tuple[float, float | None]] | None = None
) -> tuple[Feedback, ...]:
    """Of all flights that are fitted; nothing where sensors are compared with each other, of which
    none is a stick that anybody moves.

    Args:
        problem: flights, and the model, which says what is delayed.
        delays: value and sd of what a fit found, among it `time_shift` and the parameters that are
            delays [s]; None before a fit, and of one that did not arrive.
    """
    if is_kinematic(problem.model):
        return ()
    flights, made = problem.training, []
    for label, flight in zip(labels(flights), flights, strict=True):
        of_inputs = {n: _delay(problem, flight, n, delays or {}) for n in flight.inputs}
        # As early as its interval has it: what is left of a late log would still be an alarm. One
        # that may be zero is none: an input that is moved for nothing hides a fast controller.
        earlier = {n: 2.0 * sd - d for n, (d, sd, _) in of_inputs.items() if d + 2.0 * sd < 0}
        made += [
            one._replace(flight=label, delay_known=of_inputs[one.input][2])
            for one in feedback(flight, len(flights), earlier)
        ]
    return tuple(made)


def _delay(
    problem: Problem, flight: Flight, name: str, delays: Mapping[str, tuple[float, float | None]]
) -> tuple[float, float, bool]:
    """Of an input its delay and its sd [s], as far as they are known, and whether that was
    estimated."""
    delay, variance, estimated = 0.0, 0.0, False
    own = dict(problem.model.delays).get(name)
    if own is not None and own not in delays:
        stated = flight.known.get(own)
        delay = float(getattr(problem.vehicle, own) if stated is None else stated)
    for parameter in ("time_shift", own):
        value, sd = delays.get(parameter or "", (0.0, None))
        if sd is not None:
            delay, variance, estimated = delay + value, variance + sd**2, True
    return delay, math.sqrt(variance), estimated


def untested(problem: Problem) -> list[str]:
    """A sentence for the outputs of which feedback cannot be told, since too much is missing."""
    flights, lacking = problem.training, {}
    for label, flight in zip(labels(flights), flights, strict=True):
        tested = _decimated(flight, {}, _RATE).outputs
        gappy = [n for n, y in flight.outputs.items() if n not in tested and np.isnan(y).any()]
        if gappy:
            # Flights that lack the same in one sentence: parts of a run do.
            lacking.setdefault((tuple(gappy), not tested), []).append(label)
    return [
        f"{', '.join(those)}: whether the inputs follow {' or '.join(outputs)} was not tested, "
        f"since more than {percent(1 - _SEEN, 0)} of the samples are missing"
        + (", and no other output was measured." if alone else ".")
        for (outputs, alone), those in lacking.items()
    ]


def feedback_notes(
    problem: Problem, feedback: Sequence[Feedback], white: bool | None = None
) -> list[str]:
    """What a closed loop does to the estimates, and what to do; nothing where there is none.

    Args:
        problem: says the method and what can be disturbed.
        feedback: of `feedback_of`.
        white: whether the errors that the method asks to be white are; None before a fit.
    """
    present = [one for one in feedback if one.present]
    filtered = estimator_of(problem.method).process_noise
    # With disturbances in the model and white innovations the noise model is right, and the direct
    # estimate is unbiased in a closed loop too.
    if not present or (filtered and white):
        return []
    begun = f"{_what_follows(problem, present)} unbiased only if the noise model is right. "
    if filtered:
        doubt = "" if white is None else ", and they are not: disturbances or dynamics are missing"
        return [f"{begun}Filter error asks for white innovations{doubt}."]
    if _by_instrument(problem, present):
        return []
    return [
        f"{begun}That of {problem.method} knows no gusts, which feedback brings into the inputs: "
        f"in gusts its estimates are biased, and {_advised(problem, present)} is advised."
    ]


def _by_instrument(problem: Problem, present: Sequence[Feedback]) -> bool:
    """Whether all inputs that follow the response are taken by their instrument."""
    if not estimator_of(problem.method).by_instrument:
        return False
    return {one.input for one in present} <= set(instruments_of(problem))


def _advised(problem: Problem, present: Sequence[Feedback]) -> str:
    """Filter error with a disturbance where the response that is followed is disturbed."""
    axes, outputs = axes_of(problem.model), {one.output for one in present}
    own = [axis.name for axis in axes if outputs & {axis.rate, axis.angle}]
    if not axes:
        return "method: filter-error and process noise"
    if len(axes) == 1 or len(own) == 1:
        name = own[0] if own else axes[0].name
        return f"method: filter-error with disturbance: {{axis: {name}, poles: 1}}"
    named = ", ".join(own or [axis.name for axis in axes])
    return f"method: filter-error with a disturbance of each axis that gusts move ({named})"


def _what_follows(problem: Problem, present: Sequence[Feedback]) -> str:
    """Which inputs follow what, up to what holds of the estimates then."""
    sure = min(present, key=lambda one: one.p_value)
    names = list(dict.fromkeys(one.input for one in present))
    of = " and ".join(names)
    moved = f", taken {sure.earlier:.2g} s earlier as its delay says" if sure.earlier else ""
    first, last = (f"{lag:.2g}" for lag in sure.lag)
    lags = first if first == last else f"{first} to {last}"
    follows = (
        f"{of} {'follow' if len(names) > 1 else 'follows'} the response ({sure.flight}: "
        f"correlation {sure.correlation:+.2f} of what is unforeseen of {sure.input}{moved} with "
        f"what was unforeseen of {sure.output} {lags} s before)"
    )
    if all(one.delay_known for one in present):
        return f"The loop is closed: {follows}. Estimates are then"
    late = list(dict.fromkeys(one.input for one in present if not one.delay_known))
    return (
        f"{follows}: the loop is closed, or {' and '.join(late)} {'are' if len(late) > 1 else 'is'}"
        f" logged late ({_how_told(problem, late)}). In a closed loop estimates are"
    )


def _how_told(problem: Problem, late: Sequence[str]) -> str:
    """What tells inputs that are logged late from a closed loop."""
    own = dict(problem.model.delays)
    if problem.nuisance.time_shift or all(own.get(name) in problem.free for name in late):
        return "a fit that arrives tells, by its delay"
    return "free a delay: nuisance.time_shift, or delays of the model"


def _unforeseen(u: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"] | None:
    """What an input's own past does not foretell (N,), without its jumps; None where nothing is
    left.

    A pilot's test steps are larger than what he does about a gust, and would drown it. What is left
    out is chosen by the input alone, so that the test stays one.
    """
    # A commanded input that stays for twenty samples and jumps follows nothing in between; no more
    # does one whose steps are rounded off, as a programmed doublet's: what an autoregression leaves
    # of its corners rings on into the rest, as it does in the response.
    if np.mean(np.diff(u) != 0.0) < _MOVES or _rests(u) > _AT_REST:
        return None
    past = Past(u[:, None])
    left = arx_residuals(u[:, None], past)
    for _ in range(_ROUNDS):
        if left is None:
            return None
        size = float(np.nanmedian(np.abs(left)))
        calm = np.abs(left[:, 0]) <= _JUMP * size
        # An input that mostly stays where it is has no other motion than its jumps.
        if size <= 1e-9 * np.std(u):
            break
        left = arx_residuals(np.where(calm, u, np.nan)[:, None], past)
    if left is None or not np.nanstd(left) > 1e-9 * np.std(u):
        return None
    return left[:, 0]


def _rests(u: Float[np.ndarray, " N"]) -> float:
    """The part of the samples of an input that lie in long runs of one value, or as good as one: a
    command that passed a filter comes to rest by and by."""
    ends = np.flatnonzero(np.abs(np.diff(u)) > _STILL * np.ptp(u))
    runs = np.diff(np.concatenate([[-1], ends, [u.size - 1]]))
    return float(np.sum(runs[runs >= _LONG_REST])) / u.size


class _Decimated(NamedTuple):
    """Signals at a moderate rate, by name."""

    inputs: dict[str, np.ndarray]
    """those that move (N,)"""
    outputs: dict[str, np.ndarray]
    """those that are mostly seen (N,)"""
    parts: Float[np.ndarray, "N m"]
    """of the inputs: means over parts of a sample"""
    dt: float


def _decimated(flight: Flight, earlier: Mapping[str, int], rate: float) -> _Decimated:
    """A flight averaged down.

    Args:
        flight: as measured.
        earlier: by how many samples an input is taken earlier than logged, where it is.
        rate: samples a second at most [Hz].
    """
    every = max(1, int(np.ceil(1.0 / (flight.dt * rate) - 1e-9)))
    edges = np.rint(np.linspace(0, every, min(every, _PARTS) + 1)).astype(np.int64)

    def thinned(x: np.ndarray) -> np.ndarray:
        # Means of blocks and not every n-th sample: what is faster than the lower rate would come
        # back as something slow.
        return x.reshape(-1, every).mean(axis=1)  # NaN where one of them is missing

    def within(x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x.reshape(-1, every), edges[:-1], axis=1) / np.diff(edges)

    # What an input does after the end of its log is not known: all signals end there.
    cut = max(earlier.values(), default=0)

    def taken(x: np.ndarray, first: int) -> np.ndarray:
        # Of a very long record a part will do, and its regressors fit into memory.
        part = x[first : x.size - cut + first]
        return part[: min(part.size // every, _MOST) * every]

    inputs = {n: taken(u, earlier.get(n, 0)) for n, u in flight.inputs.items()}
    inputs = {n: u for n, u in inputs.items() if u.size and np.ptp(u) > 0}
    parts = [within(u) for u in inputs.values()]
    outputs = {n: thinned(taken(y, 0)) for n, y in flight.outputs.items()}
    # A record of less than one block leaves none.
    return _Decimated(
        {n: thinned(u) for n, u in inputs.items()},
        {
            n: y
            for n, y in outputs.items()
            if y.size and np.mean(np.isfinite(y)) >= _SEEN and np.nanstd(y) > 0
        },
        np.concatenate(parts, axis=1) if parts else np.zeros((0, 0)),
        flight.dt * every,
    )
