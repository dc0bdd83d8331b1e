"""Frequency responses from several flights: every output to every input that moves.

An output's response uses the parts of flights without missing samples. A window shows inputs whose
responses lie outside it, and responses whose inputs do. For noise inputs this is a random error.
For a sweep, which visits each frequency once, no average removes it. A model's response has the
same error, and there it can be computed.

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
)
from heli_jax.analysis.transfer_fit import Hold, Measured, TransferFit, fit_transfer
from heli_jax.finding import Finding, note, sentences
from heli_jax.flights.flight import Flight, own_instrument_note, own_instruments
from heli_jax.flights.holds import without_jumps
from heli_jax.flights.parts import spans

_ROUNDS = 2
"""Rounds in which a transfer function is fitted again without the error added by windows."""
_MOST_SAID = 3
"""Most outputs for which a refusal gives the reason."""
_AS_ONE = 1e-6
"""Distance of a coherence from 1 below which two inputs are proportional at all frequencies."""


type Parts = tuple[tuple[int, int, int], ...]
"""Flight, first sample and end (exclusive) of each part."""
type Names = tuple[list[str], tuple[str, ...]]
"""Names of the inputs, and of the inputs with an instrument."""


class Windows(NamedTuple):
    """Settings with which responses were computed."""

    records: Sequence[Float[np.ndarray, "c N"]]
    """Inputs, instruments and outputs of each part of a flight."""
    inputs: Sequence[int]
    """Indices among the signals."""
    instruments: Sequence[int] | None
    """Index of each input's instrument; None without instruments."""
    omega: Float[np.ndarray, " k"]
    """Frequencies [rad/s]."""
    seconds: float
    """Length of a window [s]."""


class TransferRequest(NamedTuple):
    """A transfer function to fit to one response."""

    input: str
    output: str
    zeros: int
    poles: int
    delay: bool = True
    band: tuple[float, float] | None = None
    """First and last frequency [Hz]."""
    coherence: float = 0.6
    """Least mean coherence over an octave; below it, feedback and nonlinearity dominate."""


class Settings(NamedTuple):
    """Frequencies and window length of responses."""

    band: tuple[float, float] | None = None
    """First and last frequency [Hz]; None: from two periods in a window to 0.4 of the rate."""
    window: float | None = None
    """Length [s]; None: a fifth of the longest flight, at most 30 s."""
    points: int = 120
    """Number of frequencies, equally spaced in the logarithm."""
    transfer_functions: tuple[TransferRequest, ...] = ()


class Pair(NamedTuple):
    """Response of an output to an input; arrays (k,)."""

    H: np.ndarray
    """Response, in SI units of output over input."""
    sd: np.ndarray
    """Standard deviation of the real and of the imaginary part."""
    coherence: np.ndarray
    """Partial coherence, without the parts of other inputs, in the flights where the input moves.
    """
    half95: float = Z95
    """Half-width of a 95 % interval [sd]: Student's t for the number of averages."""
    added: np.ndarray | float = 0.0
    """Subtracted error that windows add to H at the ends of records (`without_ends`)."""


class Output(NamedTuple):
    """Responses, coherence and noise of one output."""

    pairs: dict[str, Pair]
    """Responses by input."""
    multiple: np.ndarray
    """Coherence (k,) with all inputs together."""
    noise: np.ndarray
    """Density (k,) of the residual [SI^2/Hz]."""
    averages: float
    """Number of independent averages."""


class FlightResponses(NamedTuple):
    """All responses of some flights."""

    omega: np.ndarray
    """Frequencies (k,) [rad/s]."""
    outputs: dict[str, Output]
    instruments: tuple[str, ...]
    """Inputs whose responses use a logged excitation."""
    window: float
    """Length of a window [s]."""
    fits: tuple[tuple[TransferRequest, TransferFit | str], ...]
    """Fits in the requested order; a text gives the reason why one is missing."""
    holds: dict[str, Hold]
    """Hold of each input between samples."""
    notes: tuple[Finding, ...]


def flight_responses(flights: Sequence[Flight], settings: Settings = Settings()) -> FlightResponses:
    """Return the frequency responses of all flights together.

    Inputs with an instrument in every flight (`Flight.instruments`) use it.

    Args:
        flights: flights of one rate with the same inputs. An output's parts without missing samples
            are used if they are at least a window long.

    Raises:
        ValueError: rates differ, nothing moves, the band does not fit the window or the rate, or
            every output's parts are too short.
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
        notes.append(
            note("loop.instrument-unused", f"{own_instrument_note(own)}; it is not used", *own)
        )
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
            # Outputs with fewer averages than inputs must not stop the others.
            without.append(note("responses.none", f"{', '.join(group)}: no response, {e}", *group))
        windows |= dict.fromkeys(group, made)
    if not outputs:
        raise ValueError("; ".join(sentences(without[:_MOST_SAID])))
    notes += without
    notes += _moving_as_one(flights, inputs, outputs)
    holds = {n: Hold(flights[0].hold[n], dt) for n in inputs}
    fits = _fits(settings, outputs, windows, holds)
    return FlightResponses(omega, outputs, instruments, window, fits, holds, tuple(notes))


def _frequencies(settings: Settings, window: float, dt: float, step: float) -> np.ndarray:
    # Fewer than two periods in a window cannot be distinguished from the window's shape.
    # Frequencies above the input's logging rate are unknown.
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
        note("responses.still", f"{n} does not move, so that no input shows a response of it", n)
        for n in resting
    ]
    # No number below reveals the sign of this bias, so a note states it.
    without = [n for n in inputs if n not in by]
    if without:
        words = (
            f"{', '.join(without)}: assumed not to follow the outputs. If a pilot or an autopilot "
            "closes a loop, the response tends to -1/(gain of the pilot or autopilot): log the "
            "excitation (signals.instruments), or fit by filter error"
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
    """Return doubts about inputs that move together, whose responses cannot be separated."""
    pairs = (pair for output in outputs.values() for pair in output.pairs.values())
    if len(inputs) < 2 or any(np.isfinite(pair.H).any() for pair in pairs):
        return []
    U = [np.stack([f.inputs[n] - np.mean(f.inputs[n]) for n in inputs]) for f in flights]
    alike = np.abs(np.corrcoef(np.concatenate(U, axis=1))) > 1.0 - _AS_ONE
    # If no pair is proportional, one input is a sum of others.
    those = [n for n, one in zip(inputs, alike, strict=True) if np.sum(one) > 1] or inputs
    words = (
        f"{' and '.join(those)} move together, so that their responses cannot be separated; move "
        "them independently, or leave one of them out"
    )
    return [Finding("excitation.inputs-as-one", "doubt", words, subjects=tuple(those))]


def _outputs(
    windows: Windows, dt: float, names: tuple[Names, list[str]], steps: np.ndarray
) -> dict[str, Output]:
    """Return each output's responses, up to half the rate at which an input was logged.

    `steps` (inputs,) are the usual sample times of the inputs [s].
    """
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
    """Return where each signal has power of its own (signals, k).

    Elsewhere its spectrum comes from the window's sidelobes, which are coherent too. Two low-passed
    signals would show a response far above their filters.
    """
    # Imported on demand: it is slow.
    from scipy.signal import welch

    length, power = round(window / dt), 0.0
    for record in records:
        # Without the best straight line, since a drift would leak into the lowest frequencies.
        S = welch(
            record,
            window=np.hanning(length),  # pyright: ignore[reportArgumentType]
            noverlap=length // 2,
            detrend="linear",
        )[1]
        power = power + S * (1 + (record.shape[1] - length) // (length - length // 2))
    own = np.stack([is_own(S) for S in np.atleast_2d(power)])
    return own[
        :, np.clip(np.round(omega * dt * length / (2.0 * np.pi)).astype(int), 0, own.shape[1] - 1)
    ]


def steady_sd(
    omega: np.ndarray, output: Output, input: str, seconds: float
) -> tuple[np.ndarray, float]:
    """Return the sd of a response's real and imaginary part (k,), and its degrees of freedom.

    With few averages the noise is a mean over frequencies, so that weights stay smooth.

    Args:
        omega: frequencies (k,) [rad/s].
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
) -> tuple[tuple[TransferRequest, TransferFit | str], ...]:
    """Return the fitted transfer functions, or the reason why one cannot be fitted."""
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
    request: TransferRequest, output: Output, windows: Windows, holds: dict[str, Hold]
) -> TransferFit:
    omega, pair = windows.omega, output.pairs[request.input]
    hz = omega / (2.0 * np.pi)
    low, high = request.band or (0.0, np.inf)
    used = (octave_mean(omega, pair.coherence) >= request.coherence) & (hz >= low) & (hz <= high)
    H = np.where(used, pair.H, np.nan)
    # The hold is part of the model, since it adds half a sample of delay that is not the vehicle's.
    hold = holds[request.input]
    sd, freedom = steady_sd(omega, output, request.input, windows.seconds)
    measured = Measured(omega, H, sd, windows.seconds, pair.coherence, hold, freedom)
    orders = request.zeros, request.poles, request.delay
    fitted = fit_transfer(measured, *orders)
    for _ in range(_ROUNDS):
        # Windows change the transfer function as they change the record.
        added = window_error(fitted, windows, list(holds).index(request.input), hold)
        if added is None:
            break
        # Remove the complete error of the windows, including that at the ends.
        fitted = fit_transfer(measured._replace(H=H + pair.added - added), *orders)
    return fitted


_AT_REST = 0.01
"""Standard deviation below which an input is at rest in a part [fraction of its largest]."""


def groups(
    flights: Sequence[Flight], window: int, without: list[Finding]
) -> list[tuple[list[str], Parts]]:
    """Group outputs by their usable parts, so that inputs are transformed once for each group.

    Args:
        without: receives the reasons why outputs have no part.
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
    """Return the parts without a missing sample, or the reason why there are none."""
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
        f"{output}: no response, expected a part of at least {window} samples (a window) without "
        f"a missing one, got {longest} at most"
    )


def records_of(
    flights: Sequence[Flight], names: Names, outputs: list[str], parts: Parts
) -> list[np.ndarray]:
    """Return inputs, instruments and outputs (signals, N) of each part."""
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
    """Return the coherence in the flights where an input moves, from that in all flights.

    With sweeps of one stick at a time, the noise of other flights would reduce the coherence of an
    input at rest.

    Args:
        moving: indices of the inputs, or of their instruments, among the signals.
    """
    windows = np.array([max(r.shape[1] - window + 1, 0) for r in records], float)
    sizes = np.array([np.std(r[list(moving)], axis=1) for r in records])
    moves = sizes > _AT_REST * np.max(sizes, axis=0)
    used = np.sum(np.where(moves, windows[:, None], 0.0), axis=0)
    # An input that moves only in parts shorter than a window has no coherence.
    share = np.where(used > 0, used, np.sum(windows)) / np.sum(windows)
    with np.errstate(all="ignore"):
        return coherence / (coherence + share * (1.0 - coherence))


_BLOCK = 4096
"""Frequencies that are computed together, each with its images."""


def decays_within(fitted: TransferFit, seconds: float) -> bool:
    """True if the slowest mode of a transfer function falls to 1/e within a window."""
    poles = fitted.poles
    return bool(np.isfinite(poles).all() and np.all(np.real(poles) * seconds < -1.0))


def window_error(
    fitted: TransferFit, windows: Windows, input: int, hold: Hold
) -> Complex[np.ndarray, " k"] | None:
    """Return the error that windows add to the response of a transfer function.

    Returns None if the response does not decay within a window.
    """
    if not decays_within(fitted, windows.seconds):
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
    """Return a transfer function's output (N,), starting at rest at the first input value."""
    # Padding prevents the end of the record from wrapping around to its beginning.
    size = 2 * u.size
    lines = np.fft.rfft(u - u[0], size)
    omega = 2.0 * np.pi * np.arange(1, lines.size) / (size * hold.dt)
    blocks = (omega[i : i + _BLOCK] for i in range(0, omega.size, _BLOCK))
    H = np.concatenate([fitted.response(np.zeros(1)), *(fitted.sampled(w, hold) for w in blocks)])
    return np.fft.irfft(lines * H, size)[: u.size]
