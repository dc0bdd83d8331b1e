"""Frequency responses of a fitted model and of its flights, both with errors.

Measured responses are conditioned: correlated inputs are separated, and all flights are used
(`heli_jax.analysis.flight_responses`).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.analysis.attitude_responses import (
    Handling,
    HandlingPair,
    measured_handling,
    prepared,
)
from heli_jax.analysis.flight_responses import FlightResponses, Settings, flight_responses
from heli_jax.analysis.handling_qualities import handling_qualities
from heli_jax.analysis.operating_point import OperatingPoint, operating_point
from heli_jax.analysis.response_curves import (
    COHERENT,
    Acting,
    Curve,
    LinearResponses,
    Point,
    linear_responses,
    modelled_curve,
    without_hold,
)
from heli_jax.analysis.spectra import octave_mean
from heli_jax.dynamics.model import Model
from heli_jax.finding import Finding, note
from heli_jax.identification.fit import Fit
from heli_jax.identification.identifiability.verdict import Z95
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate
from heli_jax.simulation.simulate import substeps_for

MOST_PAIRS = 6
"""Most pairs of input and output with a figure."""

_BEYOND = 4.0
"""Ratio of the last frequencies of model and data."""


class FittedPair(NamedTuple):
    """Measured and modelled response of an output to an input; arrays (k,)."""

    input: str
    output: str
    omega: np.ndarray
    """Frequencies [rad/s]."""
    H: np.ndarray
    """Measured, without the hold of the input; NaN if unknown."""
    sd: np.ndarray
    """sd of the real and of the imaginary part of H."""
    coherence: np.ndarray
    model: Point
    """Model in continuous time."""
    half95: float = Z95
    """Half of the 95 % interval of H [sd]."""


NO_RESPONSES = "responses.none-of-fit"
"""Code of the note on flights without a response."""


class FittedResponses(NamedTuple):
    """Responses of a fit and its flights."""

    pairs: tuple[FittedPair, ...]
    """Most coherent pairs."""
    left_out: int
    """Number of further coherent pairs."""
    handling: tuple[Handling, ...]
    about: str
    """Point of linearisation in words; empty for a linear model."""
    notes: tuple[Finding, ...]
    incoherent: tuple[str, ...] = ()
    """Pairs without coherence, such as `lat to p`."""
    held_out: tuple[FittedPair, ...] = ()
    """Pairs of the held-out flights."""
    coherence: Mapping[str, tuple[str, float]] = {}
    """Most coherent input of each output, and its mean coherence over an octave."""


def fitted_responses(
    fit: Fit, problem: Problem, settings: Settings, requested: Sequence[HandlingPair]
) -> FittedResponses:
    """Return the responses of a fit and of its flights, and handling qualities of both."""
    try:
        responses = flight_responses(problem.training, settings)
    except ValueError as e:
        words = f"no responses of the flights and no handling qualities: {e}"
        return FittedResponses((), 0, (), "", (note(NO_RESPONSES, words),))
    known = problem.training[0].known
    params = naming.replace(fit.params, **{n: jnp.asarray(v) for n, v in known.items()})
    at = at_record(problem.model, params, fit)
    free = [n for n in fit.estimates if n in naming.names(problem.model.Params) and n not in known]
    of = linear_responses(problem.model, params, free, at.state, at.inputs)
    if not all(np.isfinite(M).all() for M in of.matrices):
        words = f"the model cannot be linearised about {at.words or 'zero'}"
        lacking = note("responses.not-linearised", words)
        return FittedResponses((), 0, (), at.words, (*responses.notes, lacking))
    curves = _Curves(fit, of, tuple(free), (responses.omega[0], _BEYOND * responses.omega[-1]))
    means = _octave_means(responses)
    pairs = _pairs(responses, curves, means)
    handling = tuple(
        Handling(
            p,
            handling_qualities(prepared(p, curves.curve(p.input, p.output)), p.kind),
            measured_handling(responses, p),
        )
        for p in requested
        if p.input in responses.holds and p.output in responses.outputs
    )
    left_out = max(len(pairs) - MOST_PAIRS, 0)
    drawn = tuple(pairs[:MOST_PAIRS])
    highest = {names: float(np.max(c)) for names, c in means.items()}
    incoherent = tuple(f"{i} to {o}" for (i, o), c in highest.items() if c < COHERENT)
    by_output = {o: (i, c) for (i, o), c in sorted(highest.items(), key=lambda pair: pair[1])}
    held_out, notes = _of_held_out(problem, settings, curves)
    return FittedResponses(
        drawn,
        left_out,
        handling,
        at.words,
        (*responses.notes, *notes),
        incoherent,
        held_out,
        {name: by_output[name] for name in responses.outputs},
    )


# Params is Any because it may be a user's class.
def at_record(model: Model, params: Any, fit: Fit) -> OperatingPoint:
    """Return the operating point of a fit's first flight, with the estimated gains."""
    signals = fit.signals[0]
    # The vehicle receives gain times the logged input.
    gains = {n: fit.nuisance.get(f"gain {n}") for n in signals.inputs}
    inputs = {
        n: np.asarray(u) * (1.0 if (gain := gains[n]) is None else gain.value)
        for n, u in signals.inputs.items()
    }
    dt = float(np.diff(signals.times[:2])[0]) if signals.times.size > 1 else 1.0
    substeps = substeps_for(dt, model.fastest)
    return operating_point(model, params, inputs, signals.measured, dt, substeps=substeps)


class _Curves(NamedTuple):
    """Responses of the fitted model with the covariance of the fit."""

    fit: Fit
    of: LinearResponses
    free: tuple[str, ...]
    band: tuple[float, float]

    def curve(self, input: str, output: str) -> Curve:
        """Return the response of an output to an input."""
        names = (*self.free, f"gain {input}", "time_shift")
        root = _root(self.fit, names)
        gain, shift = (self.fit.nuisance.get(n) for n in names[-2:])
        # The last two derivatives are by gain and delay, after those by the parameters.
        q = len(self.free)
        unit = np.eye(q + 2)
        padded = tuple(
            np.concatenate([d, np.zeros((2, *d.shape[1:]))]) for d in self.of.derivatives
        )
        delays = {n: (v, np.append(d, [0.0, 0.0])) for n, (v, d) in self.of.delays.items()}
        of = self.of._replace(derivatives=padded, delays=delays)
        acting = Acting(
            1.0 if gain is None else gain.value,
            0.0 if shift is None else shift.value,
            unit[q] if gain is not None else None,
            unit[q + 1] if shift is not None else None,
        )
        return modelled_curve(of, (input, output), root, self.band, acting)


def _root(fit: Fit, names: Sequence[str]) -> np.ndarray:
    """Return R (q, r), with R R' the covariance of the estimates.

    It is NaN for estimates that are not identifiable, zero for those that were not estimated.
    """
    known = {**fit.nuisance, **fit.estimates}
    order = [fit.verdict.names.index(n) if n in known else None for n in names]
    rows = np.zeros((len(names), len(fit.verdict.names)))
    values, vectors = np.linalg.eigh(fit.verdict.correlation)
    correlation = vectors * np.sqrt(np.maximum(values, 0.0))
    for k, (name, i) in enumerate(zip(names, order, strict=True)):
        if i is not None:
            rows[k] = _sd(known[name], fit) * correlation[i]
    return rows


def _sd(estimate: Estimate, fit: Fit) -> float:
    """Return the sd of the reported interval."""
    e = estimate
    if fit.status == "not-converged" or e.sd is None or e.lower95 is None or e.upper95 is None:
        return np.nan
    if e.lower95 * e.upper95 > 0:
        half = 0.5 * abs(e.value * np.log(e.upper95 / e.lower95))
    else:
        half = 0.5 * (e.upper95 - e.lower95)
    # A bound may cut the interval.
    return max(half / Z95, e.sd)


def _octave_means(responses: FlightResponses) -> dict[tuple[str, str], np.ndarray]:
    """Return the mean coherence over an octave (k,) by input and output."""
    return {
        (input, name): octave_mean(responses.omega, pair.coherence)
        for name, output in responses.outputs.items()
        for input, pair in output.pairs.items()
    }


def _pairs(
    responses: FlightResponses, curves: _Curves, means: Mapping[tuple[str, str], np.ndarray]
) -> list[FittedPair]:
    """Return the coherent pairs of input and output, sorted by their sums of coherence."""
    ranked = []
    for (input, name), mean in means.items():
        total = float(np.sum(mean[mean >= COHERENT]))
        if not total:
            continue
        pair = responses.outputs[name].pairs[input]
        with np.errstate(all="ignore"):
            H = without_hold(responses.omega, pair.H, responses.holds[input])
            sd = pair.sd * np.abs(H / pair.H)
        model = curves.curve(input, name).at(responses.omega)
        measured = responses.omega, H, sd, pair.coherence
        ranked.append((total, FittedPair(input, name, *measured, model, pair.half95)))
    return [fitted for _, fitted in sorted(ranked, key=lambda r: -r[0])]


def _of_held_out(
    problem: Problem, settings: Settings, curves: _Curves
) -> tuple[tuple[FittedPair, ...], tuple[Finding, ...]]:
    """Return the responses of the held-out flights, or the reason why there are none."""
    held = tuple(f for f in problem.flights if f.hold_out)
    if not held:
        return (), ()
    try:
        responses = flight_responses(held, settings)
    except ValueError as e:
        return (), (note("responses.none-held-out", f"no responses of the held-out flights: {e}"),)
    pairs = tuple(_pairs(responses, curves, _octave_means(responses))[:MOST_PAIRS])
    if pairs:
        return pairs, ()
    words = (
        "no figure of the held-out flights: none of their joint responses has a mean coherence "
        f"of {COHERENT:g} over an octave"
    )
    return (), (note("responses.none-held-out", words),)
