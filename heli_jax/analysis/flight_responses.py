"""Frequency responses of flights together: every output to every input that moves.

An output's response is taken from parts of flights without a missing sample. Windows look at a part
of a record, and see inputs whose answers lie outside of it and answers whose inputs do: of noise
this makes a random error; of a sweep, which visits each frequency once, one that no
average takes away. It is that of a model's response as well, which is known before and behind the
windows.

Source: Pintelon and Schoukens (2012), chapter 6, for the errors of windows.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from heli_jax.analysis.responses import (
    Z95,
    TooFewAveragesError,
    averaged,
    independent_shares,
    responses,
    student95,
    without_ends,
)
from heli_jax.analysis.spectra import (
    HIGHEST,
    OVERLAP,
    chosen,
    cross_spectra,
    is_own,
    octave_mean,
    segment_transforms,
)
from heli_jax.analysis.transfer_fit import Hold, Measured, TransferFit, fit_transfer
from heli_jax.finding import Finding, note, sentences
from heli_jax.flights.flight import Flight, own_instruments, own_said
from heli_jax.flights.holds import without_jumps
from heli_jax.flights.parts import spans

_ROUNDS = 2
"""in which a transfer function is fitted again without what the windows add to it"""
_MOST_SAID = 3
"""outputs of which a refusal says why they have no response"""
_AS_ONE = 1e-6
"""less than 1, coherence of two inputs that move as one at all frequencies"""


type Parts = tuple[tuple[int, int, int], ...]
"""flight, first sample and the one behind the last of each part"""
type Names = tuple[list[str], tuple[str, ...]]
"""of the inputs, and of those with an instrument"""


class Windows(NamedTuple):
    """Settings by which responses were computed."""

    records: Sequence[Float[np.ndarray, "c N"]]
    """inputs, instruments and outputs of each part of a flight"""
    inputs: Sequence[int]
    """their places among the signals"""
    instruments: Sequence[int] | None
    """as many; None without"""
    omega: Float[np.ndarray, " k"]
    """[rad/s]"""
    seconds: float
    """length of a window"""


class Wanted(NamedTuple):
    """A transfer function that is to be fitted to one response."""

    input: str
    output: str
    zeros: int
    poles: int
    delay: bool = True
    band: tuple[float, float] | None = None
    """[Hz]"""
    coherence: float = 0.6
    """frequencies of less in the mean over an octave are left out: there feedback and what is not
    linear have their way"""


class Settings(NamedTuple):
    """Frequencies and window length of responses."""

    band: tuple[float, float] | None = None
    """first and last frequency [Hz]; None: two periods in a window to 0.4 of the rate"""
    window: float | None = None
    """length [s]; None: a fifth of the longest flight, 30 s at most"""
    points: int = 120
    """frequencies, equally spaced in the logarithm"""
    transfer_functions: tuple[Wanted, ...] = ()


class Pair(NamedTuple):
    """An output's response to an input; arrays (k,)."""

    H: np.ndarray
    """in SI units of output over input"""
    sd: np.ndarray
    """of its real and of its imaginary part"""
    coherence: np.ndarray
    """partial: what the other inputs explain is taken out; of the flights in which it moves"""
    half95: float = Z95
    """half of a 95 % interval in sd: Student's t of the averages that there are"""
    added: np.ndarray | float = 0.0
    """what windows added to H at the ends of records and was taken off (`window_ends`)"""


class Output(NamedTuple):
    """Responses, coherence and noise of one output."""

    pairs: dict[str, Pair]
    """by input"""
    multiple: np.ndarray
    """(k,) coherence with all inputs together"""
    noise: np.ndarray
    """(k,) density of what they leave [SI^2/Hz]"""
    averages: float
    """independent ones"""


class FlightResponses(NamedTuple):
    """All responses of some flights."""

    omega: np.ndarray
    """(k,) [rad/s]"""
    outputs: dict[str, Output]
    instruments: tuple[str, ...]
    """inputs whose responses are taken by an excitation that was logged"""
    window: float
    """[s]"""
    fits: tuple[tuple[Wanted, TransferFit | str], ...]
    """in the order in which they were asked for; in words why there is none"""
    holds: dict[str, Hold]
    """by input what it does between samples"""
    notes: tuple[Finding, ...]


def flight_responses(flights: Sequence[Flight], settings: Settings = Settings()) -> FlightResponses:
    """Frequency responses of all flights together.

    Inputs with an instrument in every flight (`Flight.instruments`) are taken by it.

    Args:
        flights: of one rate, with the same inputs; an output's parts without a missing sample
            that are at least a window long are used.

    Raises:
        ValueError: rates differ, nothing moves, the band does not fit the window or the rate, or
            no output has a part that is long enough.
    """
    flights = [without_jumps(f) for f in flights]
    dt, window, moving = chosen(flights, settings.window)
    inputs = list(moving)
    step = {n: max(f.logged_step(n, "input") for f in flights) for n in inputs}
    omega = _frequencies(settings, window, dt, max(dt, min(step.values())))
    instruments = tuple(n for n in inputs if all(n in f.instruments for f in flights))
    own = own_instruments(flights, instruments)
    instruments = tuple(n for n in instruments if n not in own)
    notes = _notes(flights, inputs, instruments)
    for n in (n for n in inputs if omega[-1] * step[n] >= np.pi):
        rate, half = 1.0 / step[n], 0.5 / step[n]
        words = f"{n} was logged at {rate:.3g} Hz: no response to it above {half:.3g} Hz"
        notes.append(note("responses.logged-slowly", words, n, value=rate))
    if own:
        notes.append(note("loop.instrument-unused", f"{own_said(own)}; it is not used", *own))
    outputs: dict[str, Output] = {}
    windows: dict[str, Windows] = {}
    names = (inputs, instruments)
    without: list[Finding] = []
    for group, parts in groups(flights, round(window / dt), without):
        records = records_of(flights, names, group, parts)
        made = _windows(records, omega, window, names)
        try:
            outputs |= _outputs(made, dt, (names, group), np.array(list(step.values())))
        except TooFewAveragesError as e:
            # Outputs with fewer averages than inputs are no reason to keep back the others.
            without.append(note("responses.none", f"{', '.join(group)}: no response, {e}", *group))
        windows |= dict.fromkeys(group, made)
    if not outputs:
        raise ValueError("; ".join(sentences(without[:_MOST_SAID])))
    notes += without
    notes += _moving_as_one(flights, inputs, outputs)
    notes += _weak(omega, instruments, outputs)
    holds = {n: Hold(flights[0].hold[n], dt) for n in inputs}
    fits = _fits(settings, outputs, windows, holds)
    return FlightResponses(omega, outputs, instruments, window, fits, holds, tuple(notes))


def _frequencies(settings: Settings, window: float, dt: float, step: float) -> np.ndarray:
    # Fewer than two periods in a window are not told from its own shape; what moves faster than
    # an input was logged nothing is known of.
    low, high = settings.band or (2.0 / window, HIGHEST / step)
    if not low < high:
        if settings.window is None and settings.band is None:
            least = 2.0 * step / HIGHEST
            raise ValueError(
                f"the longest flight is {5.0 * window:.3g} s, too short for responses at "
                f"{1.0 / step:.4g} Hz; expected more than {5.0 * least:.3g} s, five windows of "
                "two periods at the highest frequency"
            )
        raise ValueError(
            f"window: expected one of more than {2.0 * step / HIGHEST:.3g} s, got {window:g} s"
        )
    if high >= 0.5 / dt:
        raise ValueError(
            f"band: expected frequencies below half the rate of {1.0 / dt:.4g} Hz, got {high:g} Hz"
        )
    if low < 2.0 / window * (1.0 - 1e-9):
        raise ValueError(
            f"band: expected at least two periods in a window of {window:g} s, from "
            f"{2.0 / window:.3g} Hz on; got {low:g} Hz"
        )
    return 2.0 * np.pi * np.geomspace(low, high, settings.points)


def _notes(flights: Sequence[Flight], inputs: list[str], by: tuple[str, ...]) -> list[Finding]:
    still = [n for n in flights[0].inputs if n not in inputs]
    notes = [note("responses.still", f"{n} does not move: no response to it", n) for n in still]
    outputs = dict.fromkeys(n for f in flights for n in f.outputs)
    resting = [
        n for n in outputs if not any(_moves(f.outputs[n]) for f in flights if n in f.outputs)
    ]
    notes += [
        note("responses.still", f"{n} does not move: no input is seen to move it", n)
        for n in resting
    ]
    # The bias has no sign of its own in any of the numbers below: it has to be said.
    without = [n for n in inputs if n not in by]
    if without:
        taken = "inputs that do not follow" if len(without) > 1 else "an input that does not follow"
        words = (
            f"{', '.join(without)}: taken for {taken} the outputs; where a pilot "
            "or an autopilot closes a loop the response is biased towards minus one over its gain, "
            "and a logged excitation (signals.instruments) or a fit by filter error is needed"
        )
        notes.append(note("loop.responses-direct", words, *without))
    return notes


def _moves(y: np.ndarray) -> bool:
    seen = y[np.isfinite(y)]
    return bool(seen.size) and float(np.ptp(seen)) > 0.0


def _windows(records: list[np.ndarray], omega: np.ndarray, window: float, names: Names) -> Windows:
    inputs, instruments = names
    m = len(inputs)
    z = [m + instruments.index(n) if n in instruments else i for i, n in enumerate(inputs)]
    return Windows(records, range(m), z if instruments else None, omega, window)


def _moving_as_one(
    flights: Sequence[Flight], inputs: list[str], outputs: dict[str, Output]
) -> list[Finding]:
    """Doubt about inputs that move together, whose responses cannot be separated."""
    pairs = (pair for output in outputs.values() for pair in output.pairs.values())
    if len(inputs) < 2 or any(np.isfinite(pair.H).any() for pair in pairs):
        return []
    U = [np.stack([f.inputs[n] - np.mean(f.inputs[n]) for n in inputs]) for f in flights]
    alike = np.abs(np.corrcoef(np.concatenate(U, axis=1))) > 1.0 - _AS_ONE
    # Where none is another's multiple one is a sum of others.
    those = [n for n, one in zip(inputs, alike, strict=True) if np.sum(one) > 1] or inputs
    words = (
        f"{' and '.join(those)} move as one: no response tells what each of them does; move them "
        "apart, or leave one of them out"
    )
    return [Finding("excitation.inputs-as-one", "doubt", words, subjects=tuple(those))]


def _weak(
    omega: np.ndarray, instruments: tuple[str, ...], outputs: dict[str, Output]
) -> list[Finding]:
    """Name the frequencies at which an instrument hardly moves its input."""
    notes = []
    for name in instruments:
        pairs = [output.pairs[name] for output in outputs.values()]
        weak = np.all([np.isfinite(p.coherence) & ~np.isfinite(p.sd) for p in pairs], axis=0)
        if not weak.any():
            continue
        hz, at = omega / (2.0 * np.pi), np.flatnonzero(weak)
        runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
        bands = ", ".join(f"{hz[run[0]]:.3g} to {hz[run[-1]]:.3g} Hz" for run in runs)
        words = (
            f"{name}: at {at.size} of {omega.size} frequencies ({bands}) the excitation hardly "
            "moves the input beside what feedback and pilot make of it: no response is given "
            "there; a larger or longer excitation tells"
        )
        notes.append(note("excitation.weak-instrument", words, name, value=at.size))
    return notes


def _outputs(
    windows: Windows, dt: float, names: tuple[Names, list[str]], steps: np.ndarray
) -> dict[str, Output]:
    """Each output's responses; none above half the rate at which an input was logged, whose usual
    `steps` (inputs,) [s] are."""
    (inputs, instruments), outputs = names
    records, omega, window = windows.records, windows.omega, windows.seconds
    m, first = len(inputs), len(inputs) + len(instruments)
    u, y = list(range(m)), list(range(first, first + len(outputs)))
    by = None if windows.instruments is None else list(windows.instruments)
    spectra = cross_spectra(records, dt, omega, window, OVERLAP, sloped=m)
    estimate = responses(spectra, u, y, by)
    own = _own(records, dt, omega, window)
    driven = np.all(own[:first], axis=0)
    seen = (driven & own[y]).T[:, :, None] & (omega[:, None] * steps < np.pi)[:, None]
    moving = coherence_where_moving(estimate.coherence, records, by or u, round(window / dt))
    H, sd, coherence = (np.where(seen, v, np.nan) for v in (estimate.H, estimate.sd, moving))
    assert estimate.ends is not None
    added, sd = without_ends(omega, H, sd, estimate.ends, window)
    H = H - added
    averages = estimate.averages
    half95 = float(student95(np.asarray(2.0 * (averages - m))))
    result = {}
    for i, name in enumerate(outputs):
        pairs = {
            n: Pair(
                H[:, i, j],
                sd[:, i, j],
                coherence[:, i, j],
                half95,
                added[:, i, j],
            )
            for j, n in enumerate(inputs)
        }
        result[name] = Output(pairs, estimate.multiple[:, i], estimate.noise[:, i], averages)
    return result


def _own(records: Sequence[np.ndarray], dt: float, omega: np.ndarray, window: float) -> np.ndarray:
    """At which frequencies every signal has power of its own: (signals, k).

    Where one has none its spectrum is that of the window's sidelobes, which are coherent as well:
    two signals behind low-pass filters would show a response far above them.
    """
    length = round(window / dt)
    power = 0.0
    for record in records:
        of_record = segment_transforms(record, dt, length)
        power = power + np.sum(np.abs(of_record.X) ** 2, axis=1)
    own = np.stack([is_own(S) for S in np.transpose(power)])
    return own[
        :, np.clip(np.round(omega * dt * length / (2.0 * np.pi)).astype(int), 0, own.shape[1] - 1)
    ]


def steady_sd(
    omega: np.ndarray, output: Output, input: str, seconds: float
) -> tuple[np.ndarray, float]:
    """Return the sd of a response's real and imaginary part (k,), and its degrees of freedom. With
    few averages the noise is a mean over frequencies, so that weights stay smooth.

    Args:
        omega: (k,) [rad/s]
    """
    pair = output.pairs[input]
    noise = np.where(np.isfinite(pair.H), output.noise, np.nan)
    share = independent_shares(omega, seconds)
    mean, freedom = averaged(noise, share, output.averages - len(output.pairs))
    with np.errstate(all="ignore"):
        return pair.sd * np.sqrt(mean / noise), freedom


def _fits(
    settings: Settings,
    outputs: dict[str, Output],
    windows: dict[str, Windows],
    holds: dict[str, Hold],
) -> tuple[tuple[Wanted, TransferFit | str], ...]:
    """The transfer functions, or why one cannot be fitted: the responses are there all the same."""
    fits = []
    for request in settings.transfer_functions:
        output = outputs.get(request.output)
        if output is None or request.input not in output.pairs:
            why = f"these flights have no response from {request.input} to {request.output}"
            fits.append((request, why))
            continue
        try:
            fitted = _fitted(request, output, windows[request.output], holds)
        except ValueError as e:
            fitted = str(e)
        fits.append((request, fitted))
    return tuple(fits)


def _fitted(
    request: Wanted, output: Output, windows: Windows, holds: dict[str, Hold]
) -> TransferFit:
    omega, pair = windows.omega, output.pairs[request.input]
    hz = omega / (2.0 * np.pi)
    low, high = request.band or (0.0, np.inf)
    used = (octave_mean(omega, pair.coherence) >= request.coherence) & (hz >= low) & (hz <= high)
    H = np.where(used, pair.H, np.nan)
    # With its hold, which is half a sample late, so that the delay is the vehicle's own.
    hold = holds[request.input]
    sd, freedom = steady_sd(omega, output, request.input, windows.seconds)
    measured = Measured(omega, H, sd, windows.seconds, pair.coherence, hold, freedom)
    orders = request.zeros, request.poles, request.delay
    fitted = fit_transfer(measured, *orders)
    for _ in range(_ROUNDS):
        # What the windows do to the record they do to the transfer function.
        added = window_error(fitted, windows, list(holds).index(request.input), hold)
        if added is None:
            break
        # All that they do, at the ends too.
        fitted = fit_transfer(measured._replace(H=H + pair.added - added), *orders)
    return fitted


_AT_REST = 0.01
"""of an input's largest standard deviation in a part, below which it rests in another"""


def groups(
    flights: Sequence[Flight], window: int, without: list[Finding]
) -> list[tuple[list[str], Parts]]:
    """Outputs by the parts that they are known in, so that inputs are transformed once for all of
    them.

    Args:
        without: why an output has no part is added to them.
    """
    by_parts: dict[Parts, list[str]] = {}
    order = dict.fromkeys(n for f in flights for n in f.outputs)
    for name in order:
        parts = parts_of(flights, name, window)
        if isinstance(parts, str):
            without.append(note("responses.none", parts, name))
        else:
            by_parts.setdefault(parts, []).append(name)
    return [(names, parts) for parts, names in by_parts.items()]


def parts_of(flights: Sequence[Flight], output: str, window: int) -> Parts | str:
    """The parts without a missing sample, or in words why there is none."""
    parts, longest = [], 0
    for i, f in enumerate(flights):
        if output not in f.outputs:
            continue
        for first, last in spans([f.outputs[output]]):
            longest = max(longest, last - first)
            if last - first >= window:
                parts.append((i, first, last))
    if parts:
        return tuple(parts)
    return (
        f"{output}: no response, expected a part of at least {window} samples (a window) without a "
        f"missing one, got {longest} at most"
    )


def records_of(
    flights: Sequence[Flight], names: Names, outputs: list[str], parts: Parts
) -> list[np.ndarray]:
    """Inputs, instruments and outputs (signals, N) of each part."""
    inputs, instruments = names
    return [
        np.stack(
            [
                *(flights[i].inputs[n][first:last] for n in inputs),
                *(flights[i].instruments[n][first:last] for n in instruments),
                *(flights[i].outputs[n][first:last] for n in outputs),
            ]
        )
        for i, first, last in parts
    ]


def coherence_where_moving(
    coherence: Float[np.ndarray, "k l m"],
    records: Sequence[Float[np.ndarray, "signals N"]],
    moving: Sequence[int],
    window: int,
) -> Float[np.ndarray, "k l m"]:
    """Coherence in the flights in which an input moves, of that in all.

    Of sweeps of one stick at a time the others are at rest, and the noise of those flights is
    nothing that they could be coherent with.

    Args:
        moving: the inputs, or their instruments, by their place among the signals.
    """
    windows = np.array([max(r.shape[1] - window + 1, 0) for r in records], float)
    sizes = np.array([np.std(r[list(moving)], axis=1) for r in records])
    moves = sizes > _AT_REST * np.max(sizes, axis=0)
    used = np.sum(np.where(moves, windows[:, None], 0.0), axis=0)
    # One that moves in parts alone that are shorter than a window has none.
    share = np.where(used > 0, used, np.sum(windows)) / np.sum(windows)
    with np.errstate(all="ignore"):
        return coherence / (coherence + share * (1.0 - coherence))


_BLOCK = 4096
"""frequencies at a time, each with its images"""


def forgets(fitted: TransferFit, seconds: float) -> bool:
    """True if the slowest mode of a transfer function falls to 1/e within a window."""
    poles = fitted.poles
    return bool(np.isfinite(poles).all() and np.all(np.real(poles) * seconds < -1.0))


def window_error(
    fitted: TransferFit, windows: Windows, input: int, hold: Hold
) -> Complex[np.ndarray, " k"] | None:
    """Return the error that windows add to the response of a transfer function; None if it does
    not decay within a window."""
    if not forgets(fitted, windows.seconds):
        return None
    kept = sorted({*windows.inputs, *(windows.instruments or ())})
    place = {i: j for j, i in enumerate(kept)}
    records = [
        np.concatenate([r[kept], _answer(fitted, r[windows.inputs[input]], hold)[None]])
        for r in windows.records
    ]
    spectra = cross_spectra(records, hold.dt, windows.omega, windows.seconds, OVERLAP)
    by = None if windows.instruments is None else [place[i] for i in windows.instruments]
    estimate = responses(spectra, [place[i] for i in windows.inputs], [len(kept)], by)
    return estimate.H[:, 0, input] - fitted.sampled(windows.omega, hold)


def _answer(fitted: TransferFit, u: Float[np.ndarray, " N"], hold: Hold) -> Float[np.ndarray, " N"]:
    """A transfer function's output (N,), from rest at the first value of its input."""
    # Padded, or the end of the record would wrap round onto its beginning.
    size = 2 * u.size
    lines = np.fft.rfft(u - u[0], size)
    omega = 2.0 * np.pi * np.arange(1, lines.size) / (size * hold.dt)
    blocks = (omega[i : i + _BLOCK] for i in range(0, omega.size, _BLOCK))
    H = np.concatenate([fitted.response(np.zeros(1)), *(fitted.sampled(w, hold) for w in blocks)])
    return np.fft.irfft(lines * H, size)[: u.size]
