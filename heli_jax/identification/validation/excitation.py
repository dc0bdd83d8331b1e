"""Doubts about a record that no residual shows: sampling too slow, inputs too small or too few."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.aliases import FastMode, fast_modes

ALIASED = "timing.mode-past-nyquist"
_FEEBLE = 3.0
"""rms of a response over the noise below which an input hardly excites the model"""


def notes(
    problem: Problem,
    simulated: tuple[dict[str, np.ndarray], ...],
    sd: tuple[Mapping[str, Any], ...],
) -> list[Finding]:
    """Sentences on sampling and excitation for runs simulated at the start values.

    Args:
        problem: the flights and what is free.
        simulated: by flight and output (N,), SI.
        sd: by flight and output that of the measurement noise, SI, a scalar of NumPy or JAX.
    """
    # At the start values, before anything is fitted: these doubts are worth most while a record can
    # still be flown again.
    sentences = sampling(problem, {n: f.start for n, f in problem.free.items()})
    for flight, outputs, noise in zip(problem.training, simulated, sd, strict=True):
        sentences += _feeble(flight, outputs, noise)
        sentences += _few_changes(flight, len(problem.free))
    return sentences


def _feeble(
    flight: Flight, outputs: Mapping[str, np.ndarray], noise: Mapping[str, Any]
) -> list[Finding]:
    sentences = []
    for name, y in outputs.items():
        # About its mean: a trim value that the model holds excites nothing.
        moved = float(np.std(y))
        if moved < _FEEBLE * float(noise[name]):
            words = (
                f"{flight.name or 'the flight'}: the input hardly excites the model: it moves "
                f"{name} by {moved:.2g} (rms, at the start values) where the noise is "
                f"{float(noise[name]):.2g}; use larger or more inputs."
            )
            sentences.append(note("excitation.feeble", words, name))
    return sentences


def _few_changes(flight: Flight, free: int) -> list[Finding]:
    # Every change of an input is one new piece of information at best.
    changes = sum(int(np.count_nonzero(np.diff(u))) for u in flight.inputs.values())
    # A free decay tells by its initial state.
    if changes >= free or not any(np.ptp(u) > 0 for u in flight.inputs.values()):
        return []
    words = (
        f"{flight.name or 'the flight'}: {' and '.join(flight.inputs)} "
        f"{'change' if len(flight.inputs) > 1 else 'changes'} {changes} times in the record, fewer "
        f"than there are free parameters ({free}): it excites too little."
    )
    return [note("excitation.few-changes", words, *flight.inputs)]


def sampling(problem: Problem, values: dict[str, float]) -> list[Finding]:
    """A sentence for each flight whose sampling a mode of the linearised model reaches."""
    return aliasing(fast_modes(problem, values))


def _both(omega: float) -> str:
    return f"{omega:.4g} rad/s, {omega / (2.0 * np.pi):.3g} Hz"


def aliasing(modes: Sequence[FastMode]) -> list[Finding]:
    """A sentence for each mode that the samples cannot show, as `fast_modes` finds them."""
    sentences = []
    for mode in modes:
        past = mode.frequency >= mode.nyquist
        words = (
            f"{mode.flight}: a mode at {_both(mode.frequency)}"
            f"{f' (linearised about {mode.about})' if mode.about else ''} lies "
            f"{'at or past' if past else 'near'} the Nyquist frequency of the sampling "
            f"({_both(mode.nyquist)}): the samples {'cannot' if past else 'hardly'} show it, "
            "and its aliases may be taken for slower dynamics."
        )
        criterion = f"rad/s, Nyquist {mode.nyquist:.4g}"
        brief = f"{mode.flight} has a mode {'past' if past else 'near'} its Nyquist frequency"
        sentences.append(
            Finding(
                ALIASED,
                "doubt" if mode.undetermined else "note",
                words,
                mode.frequency,
                criterion,
                (mode.flight,),
                brief=brief,
                distrusts=mode.undetermined,
            )
        )
    return sentences
