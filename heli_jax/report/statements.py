"""The verdict in one line, what a reader has to know before the numbers, and what it means."""

from typing import NamedTuple

import numpy as np

from heli_jax.identification.agreement import COLOURED
from heli_jax.identification.identifiability.analysis import ILL_CONDITIONED
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.identifiability.verdict import FACTOR
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Fit
from heli_jax.identification.validation.adequacy import EXPECTED, EXPLAINED, NEARLY_WHITE
from heli_jax.identification.validation.advice import FAR_FROM_WHITE
from heli_jax.numbers import percent
from heli_jax.vehicle import of_helicopter


class Headline(NamedTuple):
    """The verdict in one line."""

    level: str
    """good, warning or bad"""
    word: str
    text: str


def headline(fit: Fit) -> Headline:
    """Did the optimiser converge; what do the data determine; is the model adequate.

    The light is that of the exit code.
    """
    code = fit.exit_code
    level = "good" if code == 0 else "bad" if code == 4 or fit.not_identifiable else "warning"
    word, text = _determined(fit)
    return Headline(level, word, f"{text}; adequate: {fit.adequate_in_words}")


def further_sentences(fit: Fit) -> list[str]:
    """The sentences of the verdict without what the headline has said already."""
    # What the data determine is a property of an optimum.
    if fit.status == "not-converged":
        return []
    v = fit.verdict
    # One alone, of parameters that the data determine well, is what the headline says.
    alone = len(v.sentences) == 1 and not (v.resting or fit.not_identifiable or _doubts(fit))
    return [] if alone else list(v.sentences)


def _determined(fit: Fit) -> tuple[str, str]:
    """The status in words: what the data determine, and whether that may be believed."""
    v, names = fit.verdict, tuple(fit.estimates)
    # Before all else: what is said at a point that is no optimum holds for that point alone.
    if fit.status == "not-converged":
        text = "the optimiser stopped before an optimum; the numbers below are where it stopped"
        return "not converged", text
    if fit.status == "not-identifiable":
        missing = [n for n in v.names if n in v.undetermined or n in v.without_effect]
        text = f"the data do not determine {listed(missing or list(v.names))}"
        return "converged, not identifiable", text
    # The sentence must not credit the data with what a prior contributed.
    who = "the data and the priors together" if v.resting else "the data"
    text = f"{who} determine {listed(names)}"
    doubtful = _doubts(fit)
    return "converged", f"{text}, but {listed(doubtful)}" if doubtful else text


def _doubts(fit: Fit) -> list[str]:
    """What a reader has to know of estimates that are determined."""
    v = fit.verdict
    doubts = [f"{listed(v.roughly)} only roughly"] if v.roughly else []
    if v.through_zero:
        doubts.append(f"zero is in the interval of {listed(v.through_zero)}")
    if fit.overconfident:
        doubts.append("the intervals are too narrow")
    if fit.untrusted:
        doubts.append(f"{listed(fit.untrusted)} not trusted")
    if v.condition > ILL_CONDITIONED or v.pairs:
        doubts.append("they are hardly separated")
    if any(e.at_bound for e in fit.estimates.values()):
        doubts.append("an estimate is at its bound")
    return doubts


def whiteness_note(fit: Fit) -> str:
    """What coloured residuals do to the intervals; empty where the residuals are white."""
    return next((f.sentence for f in fit.findings if f.code == COLOURED), "")


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


def meanings(fit: Fit) -> list[tuple[str, str]]:
    """Heading and text of each statement, and of what residuals that are not white do to it."""
    return [
        (
            "Converged",
            "the last step changed every parameter by less than a thousandth of the sd that it "
            "would have were all else known.",
        ),
        (
            "Determined",
            "by data and priors the 95 % intervals, as they are reported, reach at most a factor "
            f"of {FACTOR:g} to either side, also without the weak priors of biases, offsets and "
            "initial states.",
        ),
        ("Adequate", _adequate(fit)),
        (
            "Not trusted",
            "a misfit that was found moves the estimate by more than half of its 95 % interval, or "
            "by an amount that is not known: the interval is withdrawn.",
        ),
        ("Residuals that are not white", _coloured(fit)),
    ]


def _adequate(fit: Fit) -> str:
    if any(output.against_disturbance is not None for output in fit.adequacy.judged):
        ahead = fit.adequacy.ahead
        what = "simulation" if ahead is None else f"predictions up to {ahead:g} s ahead"
        return (
            f"the error of the {what} has at most {EXPECTED:g} times the power that the estimated "
            "disturbance makes, with innovations that are white or have an autocorrelation below "
            f"{FAR_FROM_WHITE:g} at one sample; or the simulation explains {percent(EXPLAINED, 0)} "
            "of what is not white noise. Nothing in the record speaks against every model."
        )
    return (
        f"the simulation explains at least {percent(EXPLAINED, 0)} of what is not white noise, or "
        f"at most {percent(NEARLY_WHITE, 0)} of the residual's variance is other than that. "
        "Nothing in the record speaks against every model."
    )


def _coloured(fit: Fit) -> str:
    if fit.status == "not-converged":
        intervals = "Of a fit that stopped before an optimum no intervals are given."
    elif fit.overconfident:
        intervals = "The intervals given are not corrected for them and are too narrow."
    elif fit.coloured:
        intervals = "The intervals given are corrected for their autocorrelation."
    else:
        intervals = "There are none here, and the intervals need no correction."
    return (
        f"{intervals} A disturbance in them that knows nothing of the inputs leaves the estimates "
        "unbiased; dynamics that the model lacks bias them, and so does a disturbance under "
        "feedback, and no interval allows for that."
    )
