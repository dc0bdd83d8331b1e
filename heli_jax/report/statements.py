"""The three statements at the head of the page, and what they mean."""

import math
from typing import NamedTuple

import numpy as np

from heli_jax.identification.diagnostics.noise import COLOURED, TOO_NARROW
from heli_jax.identification.identifiability.verdict import FACTOR
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Fit
from heli_jax.identification.validation.adequacy import (
    EXPECTED,
    EXPLAINED,
    FAR_FROM_WHITE,
    NEARLY_WHITE,
)
from heli_jax.numbers import percent, vaf_percent
from heli_jax.vehicle import of_helicopter


class Line(NamedTuple):
    """One of the three statements at the head of the page."""

    level: str
    """good, warning, bad or none"""
    word: str
    text: str
    """one sentence"""


def lines(fit: Fit) -> tuple[Line, Line, Line]:
    """Did the optimiser converge; what do the data determine; is the model adequate."""
    if fit.status == "not-converged":
        stopped = "The optimiser stopped before an optimum, and these numbers are no result."
        return (
            Line("bad", "Not converged", stopped),
            Line("none", "Identifiability not judged", "The data determine numbers at an optimum."),
            Line("none", "Adequacy not judged", "A model is judged at an optimum."),
        )
    best, runs = sum(row.optimum == 1 for row in fit.starts), len(fit.starts)
    reached = f"The optimiser reached an optimum in {fit.steps} steps."
    if runs > 1:
        reached = f"{best} of {runs} runs of the optimiser reached this optimum."
    text = " ".join(filter(None, (fit.verdict.text, fit.distrust)))
    determined = Line("good", "Identifiable", text)
    if fit.status == "not-identifiable" or fit.not_identifiable:
        determined = Line("bad", "Not identifiable", text)
    elif fit.untrusted:
        determined = Line("warning", "Identifiable, not trusted", text)
    adequate = Line("bad", "Not adequate", f"{'; '.join(fit.denials)}.")
    if fit.adequate:
        shares = {n: m.vaf for n, m in fit.metrics.items() if math.isfinite(m.vaf)}
        told = "Nothing in the record speaks against the model."
        if shares:
            worst = min(shares, key=lambda n: shares[n])
            told = f"{told[:-1]}; simulated, VAF of {worst} {vaf_percent(shares[worst])}."
        adequate = Line("good", "Adequate", told)
    return Line("good", "Converged", reached), determined, adequate


def whiteness_note(fit: Fit) -> str:
    """What coloured residuals do to the intervals; empty where the residuals are white."""
    return next((f.sentence for f in fit.findings if f.code in (COLOURED, TOO_NARROW)), "")


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
