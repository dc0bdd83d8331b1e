r"""Flights held out, judged in frequency: nothing is simulated, so that it holds for unstable
machines, and in gusts.

Three questions are asked of a flight that no estimate has seen. Are its errors as large as the
noise of the fitted flights lets expect? Their squares, whitened by the spectrum that was estimated
there, are compared with Fisher's F; with $J$ their derivative and $I$ the information of the fit,

$$\chi^2 = r^T r - r^T J\,(I + J^T J)^{-1} J^T r$$

allows for the errors of the estimates. What would the flight's own estimates be? Those of one step
of Gauss and Newton are compared with the fit's by the difference of the two forms of that sum, in
the flight's own noise (Chow's test). And of what follows the excitation, how much does the
model explain? That knows nothing of how strong the gusts were.

Of a fit of frequency responses the flights' responses are compared in place of their lines, and
their noise is their own.

Sources: Chow (1960); Pintelon and Schoukens (2012), chapters 9 and 11; Brillinger (1981), chapter
8, for noise that is estimated.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.analysis.response_agreement import expected_interval
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.evaluation import Evaluation, deviations, named
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.frequency_lines import errors_of_lines
from heli_jax.identification.estimation.frequency_noise import (
    GUST_LEAST,
    GUST_PART,
    averages,
    inverse_roots,
    whitening_by,
)
from heli_jax.identification.estimation.frequency_records import Record, parts_of, records_of
from heli_jax.identification.estimation.in_time import in_time
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.estimation.noise_covariance import first_noise
from heli_jax.identification.estimation.response_weights import first_weights
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels, start_vector
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, layout_of
from heli_jax.identification.validation.excitation_test import (
    LEVEL,
    Followed,
    errors_against_excitation,
)
from heli_jax.identification.validation.excited_band import moving_outputs, with_outputs
from heli_jax.identification.validation.held_out_agreement import (
    HeldOutBand,
    HeldOutFlight,
    HeldOutFrequency,
)
from heli_jax.identification.validation.own_estimates import (
    Fitted,
    Rows,
    explained_by_estimates,
    own_estimates,
)

# Bands of frequencies that a page shows.


_FEWEST = 12
"""lines of a band at least"""


def band_edges(hz: Float[np.ndarray, " K"]) -> list[tuple[float, float]]:
    """Bands between the lowest and the highest of some frequencies, at 1, 3, 10, 30 ... Hz, each
    with some lines.
    """
    low, high = float(np.min(hz)), float(np.max(hz))
    decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    grid = np.sort(np.concatenate([10.0**decades, 3.0 * 10.0**decades]))
    edges = [low]
    for edge in grid[(grid > low) & (grid < high)]:
        above = np.sum(hz > edge) >= _FEWEST
        if above and np.sum((hz >= edges[-1]) & (hz <= edge)) >= _FEWEST:
            edges.append(float(edge))
    return list(zip(edges, [*edges[1:], high], strict=True))


_NO_SPECTRUM = "its errors have no spectrum: two of its outputs are one, or there is no noise"
_SAME_RATE = 1e-6
"""relative difference of sample times that are one"""
_SURE = 0.05
"""standard deviation of what is explained by chance, above which it is not said"""
_MISFIT = 2.0
"""squared errors of a response over their variance, from which on chance alone makes none"""


def validate_in_frequency(
    problem: Problem, at: Solution, e: Evaluation, held: Sequence[Flight], *, feedback: bool
) -> HeldOutFrequency | None:
    """The flights held out against a fit in frequency; None of a fit in time.

    Nothing is raised where that fails: the notes say so.

    Args:
        at: where the fit ended.
    """
    objective = at.layout.objective
    if not held or objective.noise_model != "spectrum":
        return None
    q = len(at.layout.of_interest)
    J = np.asarray(e.J, float)[:, :q]
    if not np.isfinite(J).all():
        return None
    fitted = Fitted(J.T @ J, deviations(J), at.layout.of_interest, np.asarray(e.named))
    with np.errstate(all="ignore"):
        try:
            judged = _by_responses if objective.fits_responses else _by_lines
            found = judged(problem, at, fitted, held)
        except (ValueError, np.linalg.LinAlgError) as error:
            words = f"Held out: not judged in frequency: {error}"
            return HeldOutFrequency((), (), (words,))
    # What feedback makes of estimates is another thing in every flight, and no news of the machine.
    return _without_estimates(found) if feedback and found.flights else found


def _without_estimates(found: HeldOutFrequency) -> HeldOutFrequency:
    left = {"estimates_p_value": None, "furthest": None, "explained": {}, "worse": ()}
    words = (
        "Held out: inputs follow the outputs, and no instrument is used: what the flights say of "
        "the parameters, and what follows their inputs, is not asked, since feedback biases both."
    )
    flights = tuple(f._replace(**left) for f in found.flights)
    return found._replace(flights=flights, notes=(*found.notes, words))


def _by_lines(
    problem: Problem, at: Solution, fitted: Fitted, held: Sequence[Flight]
) -> HeldOutFrequency:
    """At the lines of each flight, against the spectrum of the fitted ones."""
    found, lines, notes = [], [], []
    for label, flight in zip(labels(tuple(held)), held, strict=True):
        sound, why = _comparable(at, flight)
        if sound is None:
            notes.append(f"{label}, held out: not judged in frequency: {why}.")
            continue
        notes += [f"{label}, held out: {why}."] if why else []
        try:
            made = _flight_by_lines(problem, at, fitted, (label, sound))
        except np.linalg.LinAlgError:
            # What one flight lacks takes nothing off the others.
            notes.append(f"{label}, held out: not judged in frequency: {_NO_SPECTRUM}.")
            continue
        found.append(made[0])
        lines += made[1]
    return HeldOutFrequency(tuple(found), _bands(at, lines), tuple(notes))


def _comparable(at: Solution, flight: Flight) -> tuple[Flight | None, str]:
    """The flight with the outputs whose spectrum is known, or None and why; what else to say."""
    names = at.layout.outputs[0]
    common = [n for n in flight.outputs if n in names]
    if not any(abs(float(f.dt) / flight.dt - 1.0) < _SAME_RATE for f in at.data.flights):
        return None, "no fitted flight has its sample time, and so none its noise"
    if not common:
        return None, f"it has none of the outputs that were fitted ({', '.join(names)})"
    sound, still = moving_outputs(with_outputs(flight, common))
    if sound is None:
        return None, still
    if not parts_of(sound):
        return None, "no part of it has all of its outputs, which a Fourier transform needs"
    by = at.data.flights[0].by_instrument is not None
    missing = by and not flight.instruments
    said = [still] if still else []
    said += ["it holds no instrument, and only the size of its errors is judged"] if missing else []
    return sound, "; ".join(said)


class _Line(NamedTuple):
    """The lines of a record of a flight held out, by output."""

    hz: Float[np.ndarray, " K"]
    outputs: tuple[str, ...]
    squares: Float[np.ndarray, "K p"]
    """of the errors over the noise's power"""
    expected: Float[np.ndarray, "K p"]
    """of these, without what the ends took"""


def _flight_by_lines(
    problem: Problem,
    at: Solution,
    fit: Fitted,
    of: tuple[str, Flight],
) -> tuple[HeldOutFlight, list[_Line]]:
    """One flight, with its label."""
    label, flight = of
    layout = layout_of(problem, (flight,))
    data = data_of(problem, (flight,), layout)
    records, (names,) = records_of(layout), layout.outputs
    whitening = tuple(_whitening(at, flight.dt, record, names) for record in records)
    sd = {n: at.noise.sd[0][n] for n in names}
    # By the inputs themselves: by instrument there is no sum of squares.
    direct = Noise((sd,), np.zeros(()), whitening, np.zeros(()), np.ones(()))
    z = _with_nuisances(problem, at, layout, data, direct)
    errors, _, taken = jax.device_get(errors_of_lines(layout, data, direct, z, ends=True))
    squares = sum(
        float(np.sum(np.abs(np.einsum("kij,kj->ki", np.asarray(W), e)) ** 2))
        for W, e in zip(whitening, errors, strict=True)
    )
    freedom = float(sum(2 * e.size - t.numbers for e, t in zip(errors, taken, strict=True)))
    # A row for each unknown of interest, and one for what is left of the errors.
    count = len(at.layout.of_interest) + 1
    r, J = _rows(Solution(layout, data, direct, z), count)
    allowed = 2.0 * squares - explained_by_estimates(r, J, fit.information)
    chi = allowed / freedom
    of_noise = float(sum(2 * r.lines * len(names) for r in records_of(at.layout)))
    by_instrument = data.flights[0].by_instrument is not None
    own, followed = (None, None), {}
    # Of a flight without its instrument neither is asked: feedback may move the inputs.
    if by_instrument or at.data.flights[0].by_instrument is None:
        there, by = Solution(layout, data, direct, z), instruments_of(problem)
        followed = errors_against_excitation((flight,), there, errors, by if by_instrument else ())
        # In its own noise: stronger gusts would pass for another machine.
        itself = direct._replace(by_instrument=np.asarray(float(by_instrument)))

        def rows(z: Array) -> Rows:
            # By the program that there is already, though nobody asks for the ends here.
            made = jax.device_get(errors_of_lines(layout, data, direct, z, ends=True))
            noise = itself._replace(whitening=whitening_by(made.machine, made.errors))
            return _rows(Solution(layout, data, noise, z), count)

        def before(z: Array) -> Rows:
            return _rows(Solution(layout, data, itself, z), count)

        own = own_estimates(rows, before, lambda z: named(layout, data, z), z, fit)
    low, high = expected_interval(freedom, of_noise)
    lines = []
    for record, W, e, t in zip(records, whitening, errors, taken, strict=True):
        size = np.sum(np.abs(np.linalg.inv(W)) ** 2, axis=2)
        expected = np.maximum(1.0 - t.power / size, 0.0)
        lines.append(_Line(_hz(record, flight.dt), names, np.abs(e) ** 2 / size, expected))
    return (
        HeldOutFlight(label, chi, low, high, freedom, *own, *_explained(followed), None),
        lines,
    )


def _rows(there: Solution, count: int) -> Rows:
    """So many rows, in units in which noise has variance 1, and their derivative by what is of
    interest."""
    made = residual_and_jacobian(*there)
    # Behind them stand the priors, which are none of this flight's news.
    q = len(there.layout.of_interest)
    return Rows(np.asarray(made.r)[:count], np.asarray(made.J)[:count, :q])


def _with_nuisances(
    problem: Problem, at: Solution, layout: Layout, data: Data, noise: Noise
) -> Array:
    """The estimates, with the nuisances of another layout."""
    # Rows of a linear model do not hang on these; others are linearised where they put it.
    first = layout.first_nuisance
    z = jnp.zeros(layout.size, at.z.dtype).at[:first].set(at.z[:first])
    if layout.model.linear:
        return z
    z = z.at[first:].set(start_vector(layout, data, problem)[first:])
    return in_time(layout, data, noise, z)


def _whitening(
    at: Solution, dt: float, record: Record, names: Sequence[str]
) -> Complex[np.ndarray, "K p p"]:
    """What makes white, at the lines of a record, the noise of the fitted flights."""
    alike = [
        (fitted, np.asarray(W))
        for fitted, W in zip(records_of(at.layout), at.noise.whitening, strict=True)
        if abs(float(at.data.flights[fitted.flight].dt) / dt - 1.0) < _SAME_RATE
    ]
    fitted, W = max(alike, key=lambda v: v[0].lines)
    counts = tuple(Counter(r.lines for r in records_of(at.layout)).items())
    p = W.shape[1]
    n = np.maximum(averages(fitted.lines, counts, GUST_PART, GUST_LEAST), p + 1.0)
    # The fit's own weights allow twice for a spectrum that is estimated: for what it makes of
    # errors that it was not estimated from, as here, and for the estimates'.
    W = W * np.sqrt(n / (n - p))[:, None, None]
    known = [at.layout.outputs[0].index(name) for name in names]
    if len(known) < p:
        L = np.linalg.inv(W)[:, known]
        W = inverse_roots(L @ np.conj(np.swapaxes(L, 1, 2)))
    f = np.arange(1, record.lines + 1) / record.samples
    at_f = np.arange(1, fitted.lines + 1) / fitted.samples
    flat = W.reshape(len(W), -1)
    flat = [np.interp(f, at_f, v.real) + 1j * np.interp(f, at_f, v.imag) for v in flat.T]
    made = np.stack(flat, axis=1).reshape(len(f), *W.shape[1:])
    # Below what the fitted flights show noise may grow as that of a random walk.
    return made * np.minimum(f / at_f[0], 1.0)[:, None, None]


def _explained(followed: dict[str, Followed]) -> tuple[dict[str, float], tuple[str, ...]]:
    """By output what is explained, where that is known, and the outputs where the model is worse
    than none."""
    level = LEVEL / max(len(followed), 1)
    worse = [n for n, f in followed.items() if f.p_value < level and not f.explained >= 0.0]
    # Of an output that hardly follows the excitation any share would be one of noise. What chance
    # takes off may be more than is left.
    known = [n for n, f in followed.items() if f.by_chance < _SURE or n in worse]
    return {n: min(followed[n].explained, 1.0) for n in known}, tuple(worse)


def _hz(record: Record, dt: float) -> Float[np.ndarray, " K"]:
    """The lines of a record."""
    return np.arange(1, record.lines + 1) / (record.samples * dt)


def _bands(at: Solution, lines: Sequence[_Line]) -> tuple[HeldOutBand, ...]:
    """By output and band, over all flights."""
    flights = at.data.flights
    fitted = [_hz(r, float(flights[r.flight].dt)) for r in records_of(at.layout)]
    fitted, found = np.concatenate(fitted), []
    for name in dict.fromkeys(n for line in lines for n in line.outputs):
        own = [(v, v.outputs.index(name)) for v in lines if name in v.outputs]
        hz = np.concatenate([v.hz for v, _ in own])
        squares = np.concatenate([v.squares[:, j] for v, j in own])
        expected = np.concatenate([v.expected[:, j] for v, j in own])
        for low, high in band_edges(hz):
            within, of_noise = ((v >= low) & (v <= high) for v in (hz, fitted))
            numbers = float(np.sum(expected[within]))
            if not numbers > 0:
                continue
            ends = expected_interval(2.0 * numbers, 2.0 * float(np.sum(of_noise)))
            chi = float(np.sum(squares[within])) / numbers
            found.append(HeldOutBand(name, low, high, chi, *ends))
    return tuple(found)


def _by_responses(
    problem: Problem, at: Solution, fitted: Fitted, held: Sequence[Flight]
) -> HeldOutFrequency:
    """By the responses of each flight; of those that are too short by themselves, together."""
    found, short, notes = [], {}, []
    by = instruments_of(problem)
    for label, flight in zip(labels(tuple(held)), held, strict=True):
        # Those of the inputs themselves may be what feedback makes of them, whatever the model.
        if lacks := _without_instrument(flight, by):
            words = f"no instrument of {', '.join(lacks)} moves in it, and the fit is by instrument"
            notes.append(f"{label}, held out: not judged in frequency: {words}.")
            continue
        sound, said = moving_outputs(flight)
        if sound is None:
            said = f"not judged in frequency: {said}"
        notes += [f"{label}, held out: {said}."] if said else []
        if sound is None:
            continue
        try:
            found.append(_responses_of(problem, at, fitted, (label, (sound,))))
        except ValueError as error:
            short[label] = (sound, str(error))
    if len(short) > 1:
        flights = tuple(flight for flight, _ in short.values())
        try:
            found.append(_responses_of(problem, at, fitted, (", ".join(short), flights)))
            short = {}
        except ValueError:
            pass
    notes += [f"{n}, held out: not judged in frequency: {why}." for n, (_, why) in short.items()]
    return HeldOutFrequency(tuple(found), (), tuple(notes))


def _without_instrument(flight: Flight, by: Sequence[str]) -> list[str]:
    """Those of some inputs whose instrument a flight lacks; all where none of its own moves."""
    if not any(np.ptp(flight.instruments[n]) > 0 for n in by if n in flight.instruments):
        return list(by)
    return [n for n in by if n not in flight.instruments]


def _responses_of(
    problem: Problem, at: Solution, fitted: Fitted, of: tuple[str, tuple[Flight, ...]]
) -> HeldOutFlight:
    """Of some flights together, with their label, in windows as long as those of the fitted ones.

    Raises:
        ValueError: they leave nothing to compare.
    """
    label, flights = of
    layout = layout_of(problem, flights)
    data = data_of(problem, flights, layout)
    noise = first_noise(problem, flights)
    if noise.whitening == ():
        # What it was refused for.
        first_weights(problem, flights)
    z = _with_nuisances(problem, at, layout, data, noise)
    z, noise = layout.objective.relax(layout, data, noise, z)
    count = 2 * noise.whitening.used.size

    def before(z: Array) -> Rows:
        return _rows(Solution(layout, data, noise, z), count)

    def rows(z: Array) -> Rows:
        z, left = layout.objective.relax(layout, data, noise, z)
        return _rows(Solution(layout, data, left, z), count)

    agreement = layout.objective.response_agreement(layout, data, noise, z, fitted=False)
    assert agreement is not None
    added = explained_by_estimates(*before(z), fitted.information)
    chi = agreement.chi_squared - added / agreement.freedom
    agreement = agreement._replace(chi_squared=chi)
    own = own_estimates(rows, before, lambda z: named(layout, data, z), z, fitted)
    ends = agreement.lower95, agreement.upper95, agreement.freedom
    worse = {
        p.output: None
        for p in agreement.pairs
        if chi > agreement.upper95 and p.chi_squared > max(p.of_none, _MISFIT)
    }
    return HeldOutFlight(label, chi, *ends, *own, {}, tuple(worse), agreement)
