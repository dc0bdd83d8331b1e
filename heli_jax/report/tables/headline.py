"""The verdict in one line, and what a reader has to know before the numbers."""

from typing import NamedTuple

import numpy as np

from heli_jax.identification.identifiability.analysis import ILL_CONDITIONED
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Fit
from heli_jax.numbers import vaf_text
from heli_jax.report.fit_content import whiteness_note
from heli_jax.vehicle import of_helicopter


class Headline(NamedTuple):
    """The verdict in one line."""

    level: str
    """good, warning or bad"""
    word: str
    text: str


def headline(fit: Fit) -> Headline:
    """Did the optimiser arrive; what do the data determine; is the model adequate."""
    level, word, text = _determined(fit)
    if not fit.adequate:
        worst = fit.adequacy.less_than_mean or level == "bad"
        level = "bad" if worst else "warning"
    if (fit.adequacy.coloured or fit.adequacy.one_step_only) and level == "good":
        level = "warning"
    doubt = held_out_doubt(fit)
    if doubt and level == "good":
        level = "warning"
    held = f". Held out: {doubt}" if doubt else ""
    return Headline(level, word, f"{text}; adequate: {adequate(fit)}{held}")


def held_out_doubt(fit: Fit) -> str:
    """What flights held out have against the fit, in a few words; empty where nothing."""
    # A simulation of an unstable machine leaves any flight: in frequency nothing is simulated.
    if fit.held_out_frequency is not None and fit.held_out_frequency.flights:
        return fit.held_out_frequency.doubt
    worse = [f"{n} ({vaf_text(m.vaf)})" for n, m in fit.validation.items() if not m.vaf >= 0]
    return f"worse than the mean (VAF): {', '.join(worse)}" if worse else ""


def further_sentences(fit: Fit) -> list[str]:
    """The sentences of the verdict without what the headline has said already."""
    # What the data determine is a property of an optimum.
    if fit.status == "not-converged":
        return []
    said, lines = _determined(fit).text, []
    for sentence in fit.verdict.sentences:
        # Both begin with "the data": one of them as a sentence, the other after a colon.
        words = f"t{sentence[1:]}" if sentence.startswith("The ") else sentence
        claim, colon, remedy = words.removesuffix(".").partition(": ")
        # Up to its end or a comma: "the data determine a" is not said by "... determine a and b".
        repeated = said == claim or said.startswith(f"{claim}, but ")
        if not repeated:
            lines.append(sentence)
        elif colon:
            lines.append(f"{remedy[0].upper()}{remedy[1:]}.")
    return lines


def adequate(fit: Fit) -> str:
    """`yes`, `in size only (...)`, `no (...)`; what stopped before an optimum was not judged."""
    return fit.adequacy.summary


def _determined(fit: Fit) -> Headline:
    """The status in words: what the data determine, and whether that may be believed."""
    v, names = fit.verdict, tuple(fit.estimates)
    # Before all else: what is said at a point that is no optimum holds for that point alone.
    if fit.status == "not-converged":
        text = "the optimiser stopped before an optimum; the numbers below are where it stopped"
        return Headline("bad", "not converged", text)
    if fit.status == "not-identifiable":
        missing = [n for n in v.names if n in v.undetermined or n in v.without_effect]
        text = f"the data do not determine {listed(missing or list(v.names))}"
        return Headline("bad", "converged, not identifiable", text)
    resting = bool(v.resting)
    # The sentence must not credit the data with what a prior contributed.
    who = "the data and the priors together" if resting else "the data"
    text = f"{who} determine {listed(names)}"
    doubtful = _doubts(fit)
    if doubtful:
        text += f", but {listed(doubtful)}"
    return Headline("warning" if doubtful or resting else "good", "converged", text)


def _doubts(fit: Fit) -> list[str]:
    """What a reader has to know of estimates that are determined."""
    v = fit.verdict
    doubts = [
        (f"{listed(v.roughly) if v.roughly else ''} only roughly", bool(v.roughly)),
        (
            f"zero is in the interval of {listed(v.through_zero) if v.through_zero else ''}",
            bool(v.through_zero),
        ),
        ("the intervals are too narrow", fit.overconfident),
        # Where the noise's spectrum is estimated nothing asks them to be white.
        ("the residuals are not white", fit.coloured and not fit.white and not _by_spectrum(fit)),
        # Widened though each residual is white by itself: then several outputs err together.
        ("residuals of outputs are correlated", fit.coloured and fit.white),
        (
            f"{listed(fit.untrusted) if fit.untrusted else ''} not to be trusted",
            bool(fit.untrusted),
        ),
        ("they are hardly separated", v.condition > ILL_CONDITIONED or bool(v.pairs)),
        ("an estimate is at its bound", any(e.at_bound for e in fit.estimates.values())),
    ]
    return [words for words, is_so in doubts if is_so]


def _by_spectrum(fit: Fit) -> bool:
    return estimator_of(fit.method).noise_spectrum


def warnings(fit: Fit) -> list[str]:
    """What a reader has to know before the numbers."""
    # Whiteness first: the template takes the first one for it where residuals are not white.
    note = whiteness_note(fit)
    return ([note] if note else []) + list(fit.notes)


def model_remark(problem: Problem) -> str:
    """Why an inertia found here is a number of the paper's model; empty for other models."""
    # A model with parameters of its own need not have the paper's equations 14 and 15.
    if not of_helicopter(problem.model.Params):
        return ""
    factor = float(np.asarray(problem.vehicle.cyclic_moment))
    return (
        "Ixx and If are numbers of the paper's model, not of the machine: eqs 14-15 have the "
        f"factor 1/2 (cyclic_moment, here {factor:g}) where blade-element theory averaged over a "
        "turn gives 1/8 for two blades, and the inertia that is found grows and shrinks with it. "
        "Compare an estimate with a weighed or swung inertia only with that in mind."
    )
