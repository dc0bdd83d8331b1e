"""Common steps from tables of rows, and topics with clocks of their own, to a `Flight`.

Sentences about a wrong log are not among it: they name rows of a table, and seconds of a topic.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight, Source
from heli_jax.flights.holds import LOW_PASSED, Decision, decide, low_passed
from heli_jax.flights.repeats import repeats_removed
from heli_jax.flights.request import Request
from heli_jax.flights.resample import (
    OWN,
    Timed,
    at_nearest,
    at_own_rate,
    goes_down,
    held_low_passed,
    held_mean,
    held_until_jumps,
    hold,
    in_gaps,
    is_slower,
    longest_gap,
    own_clock,
    resampled,
    slower_words,
    usual_step,
)
from heli_jax.flights.table import shown

Key = tuple[str, str]
"""a model's name, and `input` or `output`"""
_NO_HOLD = Decision("", "")
FEWEST = 8
"""samples in a run"""
MOST_UPSAMPLING = 100
"""times the log's rate: more is a slip, and fills the memory with straight lines"""


class LongGap(NamedTuple):
    """A step that nothing should bridge: the sample before it, its size and the limit [s]."""

    row: int
    step: float
    most: float


def long_gap(seconds: np.ndarray) -> LongGap | None:
    """The longest step between stamps (N,) [s] where it is too long to be bridged."""
    steps, most = np.diff(seconds), longest_gap(seconds)
    row = int(np.argmax(steps))
    # A step of exactly the limit, but for its rounding, passes.
    return LongGap(row, float(steps[row]), most) if steps[row] > most * (1 + 1e-9) else None


def window_note(
    window: tuple[float, float] | None, end: float, step: float = 0.0
) -> tuple[Finding, ...]:
    """A note where a window reaches beyond the log, else none."""
    if window is None or (window[0] >= 0 and window[1] <= end + 1.001 * step):
        return ()
    words = f"the window from {window[0]:g} s to {window[1]:g} s was cut to the log"
    return (note("windows.cut", f"{words}, which ends at {end:.6g} s", value=end),)


def even_expected(seconds: np.ndarray, usual: float) -> str:
    """Return the remedy for stamps (N,) [s] that are no uniform grid; `usual` is the step [s] of
    most."""
    # Where a gap is too long to be bridged, a rate would only lead to the next error.
    bridged = long_gap(seconds) is None
    remedy = f"`rate: {1 / usual:.4g}` to resample, or " if bridged else ""
    # The parts beside it may well be uniform.
    split = "" if bridged else " or `gaps: split`"
    return f"expected a uniform grid; give {remedy}a window without such steps{split}"


def decided_holds(request: Request, values: Mapping[Key, np.ndarray]) -> dict[str, Decision]:
    """Decide the hold of each input: as stated, or by its own samples (N,)."""
    holds = {}
    for (key, kind), signal in request.signals.items():
        if kind == "input":
            stated = Decision(signal.hold, "")  # no reason: the log decided nothing
            holds[key] = decide(values[key, kind]) if signal.hold == "auto" else stated
    return holds


def sample_notes(request: Request, signals: Mapping[Key, Timed]) -> list[Finding]:
    """A note for every output with missing samples: how many, and where in the log."""
    notes = []
    for key, signal in signals.items():
        missing = np.isnan(signal.values)
        count = int(missing.sum())
        if count:
            name = shown(request.signals[key].name)
            words = f"{count} of {missing.size} samples of {name} {'is' if count == 1 else 'are'}"
            words += f" missing, {_where(signal.seconds[missing], missing)}"
            notes.append(note("samples.missing", words, key[0], value=count))
    return notes


def _where(seconds: np.ndarray, missing: np.ndarray) -> str:
    """Describe the missing samples: their times [s] and their indices of all samples (N,)."""
    first, last = f"{seconds[0]:.6g} s", f"{seconds[-1]:.6g} s"
    if seconds.size == 1:
        return f"at {first}"
    runs = int(missing[0]) + int(np.count_nonzero(missing[1:] & ~missing[:-1]))
    if runs == 1:
        return f"all from {first} to {last}"
    return f"in {runs} places from {first} to {last}"


def measured_once(
    request: Request, signals: Mapping[Key, Timed]
) -> tuple[dict[Key, np.ndarray], list[Finding]]:
    """The signals (N,), repeated values of slow outputs taken as missing, and notes."""
    outputs = request.of_kind("output", signals)
    stated = {name: request.signals[name, "output"].repeats for name in outputs}
    made, notes = repeats_removed(outputs, stated)
    values = {key: signal.values for key, signal in signals.items()}
    return {**values, **{(name, "output"): y for name, y in made.items()}}, notes


class OnGrid(NamedTuple):
    """Signals on a grid: samples (M,) by key, what inputs do between them, and notes."""

    samples: dict[Key, np.ndarray]
    holds: dict[str, Decision]
    notes: list[Finding]


def at_times(
    request: Request,
    signals: Mapping[Key, Timed],
    holds: Mapping[str, Decision],
    times: np.ndarray,
) -> OnGrid:
    """The signals on a grid.

    A held input has the mean of what it was until the grid's next instant; a mixed one jumps at the
    instant nearest to its jump. Other inputs and the outputs are interpolated, or low-pass filtered
    where the rate goes down; outputs that are slower than the grid stand at the instants nearest to
    their own. A held input that a low-passed output follows within a sample is low-passed too, and
    is linear between samples then. Args: request: names them. signals: by key, SI, each on its own
    clock. holds: by input. times: of the grid (M,) [s].
    """
    samples, notes, rate = {}, [], 1.0 / float(times[1] - times[0])
    alike = _alike(request, signals, holds, times)
    # A linear vehicle answers a filtered stick with the filtered motion. The mean of each step,
    # beside an output that is filtered alone, leaves the ringing of the output's jumps to be
    # explained by the vehicle.
    low = {n: held_low_passed(*signals[n, "input"], times) for n in alike}
    for (key, kind), signal in signals.items():
        if kind == "input":
            if holds[key].hold == "mixed" and not goes_down(signal.seconds, times):
                samples[key, kind] = held_until_jumps(*signal, times)
            elif holds[key].hold != "zero-order":
                samples[key, kind] = resampled(*signal, times)
            elif key in alike:
                samples[key, kind] = low[key]
                outputs = ", ".join(alike[key])
                follow = "follow" if len(alike[key]) > 1 else "follows"
                words = (
                    f"{key} is low-passed as well and linear between samples, since {outputs} "
                    f"{follow} it within a sample: filtered alike, both keep what is between them"
                )
                notes.append(note(LOW_PASSED, words, key))
            else:
                # A low-pass filter would turn a stick that jumps into one that rings.
                samples[key, kind] = held_mean(*signal, times)
                if not np.isin(samples[key, kind], signal.values).all():
                    notes += _between(request, signals, key, times)
        elif is_slower(signal, rate):
            placed = at_nearest(signal, times)
            samples[key, kind] = placed.samples
            words = slower_words(shown(request.signals[key, kind].name), placed, signal, rate)
            count = int(np.count_nonzero(np.isfinite(placed.samples)))
            notes.append(note("resampling.slower", words, key, value=count))
        else:
            own = own_clock(signal)
            # Missing rows are no longer there to say where too much is missing.
            gaps = in_gaps(own.seconds, times) if own is not signal else False
            jumps = [n for n in alike if request.options.follows.get((n, key))]
            if jumps:
                inputs = [(signals[n, "input"], low[n]) for n in jumps]
                made = _resampled_with(own, inputs, times)
            elif usual_step(own.seconds) * rate > OWN or goes_down(own.seconds, times):
                made = resampled(*own, times)
            else:
                made = at_own_rate(own, times)
            samples[key, kind] = np.where(gaps, np.nan, made)
    decided = {n: low_passed(alike[n]) if n in alike else d for n, d in holds.items()}
    # What was low-passed has no jumps left.
    decided |= {
        n: d._replace(hold="linear")
        for n, d in holds.items()
        if d.hold == "mixed" and goes_down(signals[n, "input"].seconds, times)
    }
    return OnGrid(samples, decided, notes)


def _between(
    request: Request, signals: Mapping[Key, Timed], name: str, times: np.ndarray
) -> list[Finding]:
    """Note held inputs that move between the samples of outputs that jump with them."""
    signal = signals[name, "input"]
    jump = [o for (i, o), at_once in request.options.follows.items() if i == name and at_once]
    # What is low-passed is no longer here, and a slower one has its samples where they were.
    rate = 1.0 / float(times[1] - times[0])
    jump = [
        o for o in jump if (o, "output") in signals and not is_slower(signals[o, "output"], rate)
    ]
    if not jump or not goes_down(signal.seconds, times):
        return []
    hz = 1.0 / usual_step(signal.seconds)
    words = (
        f"{', '.join(jump)} and {name} jump together, and {name} was logged at about {hz:.4g} Hz: "
        "its mean over a step is not what they show at the step's beginning, and estimates suffer; "
        f"a rate as high as that of {name} keeps both as they are"
    )
    return [note("resampling.jumps-averaged", words, name, *jump, value=hz)]


def _alike(
    request: Request,
    signals: Mapping[Key, Timed],
    holds: Mapping[str, Decision],
    times: np.ndarray,
) -> dict[str, list[str]]:
    """The held inputs that have to be filtered, with the filtered outputs that follow them within a
    sample of the grid (M,) [s]."""
    alike: dict[str, list[str]] = {}
    for name, output in request.options.follows:
        if holds.get(name, _NO_HOLD).hold == "zero-order" and (output, "output") in signals:
            own = own_clock(signals[output, "output"])
            if goes_down(own.seconds, times):
                alike.setdefault(name, []).append(output)
    return alike


def _resampled_with(
    signal: Timed, inputs: Sequence[tuple[Timed, np.ndarray]], times: np.ndarray
) -> np.ndarray:
    """Low-pass an output (M,) that jumps with inputs.

    The jump is taken from the inputs, scaled by least squares, because it is known at all times.
    The output's samples alone would put it half a step early.

    Args:
        inputs: held ones that it follows at the very sample, each with what `held_low_passed`
            makes of it.
        times: (M,) [s].
    """
    seconds, values = signal
    held = np.array([hold(*u, np.maximum(seconds, u.seconds[0])) for u, _ in inputs])
    moves = np.diff(values)
    known = np.isfinite(moves)
    # Of an input that never jumps the least norm makes nothing.
    gains = np.linalg.lstsq(np.diff(held)[:, known].T, moves[known], rcond=None)[0]
    jumping = gains @ np.array([low for _, low in inputs])
    return resampled(seconds, values - gains @ held, times) + jumping


def flight_of(
    request: Request,
    samples: Mapping[Key, np.ndarray],
    dt: float,
    t0: float,
    holds: Mapping[str, Decision],
    source: Source,
) -> Flight:
    """The flight of samples (N,) on one grid."""
    options = request.options
    return Flight(
        dt=dt,
        inputs=request.of_kind("input", samples),
        outputs=request.of_kind("output", samples),
        t0=t0,
        sd=request.noise(),
        known=request.known,
        hold_out=options.hold_out,
        name=options.name,
        source=source,
        hold={key: decision.hold for key, decision in holds.items()},
        hold_reason={key: decision.reason for key, decision in holds.items() if decision.reason},
    )
