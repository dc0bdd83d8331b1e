"""The acceptance card: the usual gates of rotorcraft identification, each passed or failed.

Its first gates are the three statements of a fit: whatever makes a `no` there, no gate of a usual
card may see it, and a card that is passed must not stand beside a `no`.
"""

import math
from typing import NamedTuple

import numpy as np

from heli_jax.analysis.spectra import COHERENT
from heli_jax.identification.fit import Estimate, Fit
from heli_jax.identification.identifiability.verdict import ILL_CONDITIONED
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.adequacy import EXPECTED
from heli_jax.identification.validation.held_out import LEVEL
from heli_jax.identification.validation.metrics import Metrics
from heli_jax.numbers import number, p_value, percent, vaf_percent
from heli_jax.report.fitted_responses import FittedResponses

CRAMER_RAO, INSENSITIVITY, COHERENCE = 20.0, 10.0, COHERENT
"""Tischler and Remple, Aircraft and Rotorcraft System Identification (2012)"""
CORRELATION = 0.9
"""Klein and Morelli, Aircraft System Identification (2006)"""
THEIL, THEIL_PART = 0.3, 0.1
"""Jategaonkar, Flight Vehicle System Identification (2006)"""
# Nobody's law: what this program asks of a simulation. The page says so.
VAF, NRMSE_FIT = 0.9, 70.0
_RESTS = 0.5
"""share of a variance that priors explain, from which on the card names the parameter"""
_VAF = "VAF"
_CORRELATED = "largest correlation"
_BIAS_PART = "Theil bias part"


class Gate(NamedTuple):
    """One line of the card."""

    what: str
    of: str
    """the parameter, output or flight"""
    value: float
    """NaN where there is none"""
    unit: str
    gate: str
    """in words; empty where nothing is asked"""
    passed: bool | None
    """None where the line informs and nothing is asked"""
    remark: str = ""
    words: str = ""
    """text in place of a number"""


def card(problem: Problem, fit: Fit, responses: FittedResponses | None = None) -> tuple[Gate, ...]:
    """Every line: the verdicts, parameters, their relations, agreement, whiteness, coherence.

    None of a fit that stopped before an optimum: its numbers are no result.
    """
    if fit.status == "not-converged":
        return ()
    lines = _of_verdicts(fit)
    for name, estimate in fit.estimates.items():
        lines += _of_parameter(name, estimate, own_prior=problem.free[name].prior is not None)
    lines += _of_relations(fit)
    # With process noise estimated, a simulation departs from the record even with the true
    # parameters: the gates apply to the prediction one step ahead, and the simulation informs.
    # Where the noise's spectrum is estimated the fit simulates nothing either.
    noise_model = objective_of(fit.method).noise_model
    filtered = noise_model != "white"
    sources = (
        (fit.metrics, "simulated", not filtered),
        (fit.one_step, "one step ahead", True),
        (fit.validation, "held out, simulated", not filtered),
        (fit.one_step_validation, "held out, one step ahead", True),
    )
    for metrics, source, judged in sources:
        for name, m in metrics.items():
            fitted_mean = _mean_is_fitted(fit)
            lines += _of_agreement(name, m, source, judged=judged, fitted_mean=fitted_mean)
    lines += _of_held_out(fit)
    lines += _of_disturbance(fit)
    errors = "innovations" if noise_model == "disturbance" else "residuals"
    lines += _of_whiteness(fit, f"whiteness of {errors}, p-value")
    lines += _of_coherence(responses)
    return tuple(lines)


def failed(lines: tuple[Gate, ...]) -> tuple[Gate, ...]:
    """The gates that are not passed."""
    return tuple(gate for gate in lines if gate.passed is False)  # None passed nothing, nor failed


def summary(lines: tuple[Gate, ...], most: int | None = None) -> str:
    """`13 of 15 gates passed; failed: Cramér-Rao of If (34 %)`; at most `most` are named."""
    if not lines:
        return "none, since the optimiser stopped before an optimum"
    asked, missed = [gate for gate in lines if gate.passed is not None], failed(lines)
    text = f"{len(asked) - len(missed)} of {len(asked)} gates passed"
    if missed:
        named = missed if most is None else missed[:most]
        words = (f"{gate.what} of {gate.of} ({shown(gate)})" for gate in named)
        text += "; failed: " + ", ".join(words)
        if len(missed) > len(named):
            text += f" and {len(missed) - len(named)} more (report)"
    return text


def shown(gate: Gate) -> str:
    """The value as text."""
    if gate.words:
        return gate.words
    if math.isnan(gate.value):
        return "none"
    if gate.what == _VAF:
        return vaf_percent(gate.value)
    text = number(gate.value, 3)
    if gate.what == _CORRELATED:
        # Two digits of what is missing to one, where three in all would say 1.
        missing = max(1.0 - abs(gate.value), 2e-5)
        text = f"{gate.value:+.{max(3, math.ceil(1.0 - math.log10(missing)))}f}"
        text = text.replace("-", "−")
    return f"{text} {gate.unit}" if gate.unit else text


def _most(what: str, of: str, value: float, unit: str, most: float, remark: str = "") -> Gate:
    gate = f"at most {most:g} {unit}".rstrip()
    # A NaN compares as False, and so fails. bool(): `failed` asks for False itself, which NumPy's
    # own is not.
    return Gate(what, of, value, unit, gate, bool(value <= most), remark)


def _least(what: str, of: str, value: float, unit: str, least: float, remark: str = "") -> Gate:
    gate = f"at least {least:g} {unit}".rstrip()
    return Gate(what, of, value, unit, gate, bool(value >= least), remark)


def _of_verdicts(fit: Fit) -> list[Gate]:
    """Gates of the statements: the reason for its `no` need not show in any number of the card."""
    determined = "determined" if fit.verdict.identifiable else "not determined"
    shares = {n: s for n, s in fit.verdict.prior_share.items() if s > _RESTS}
    if fit.verdict.identifiable and shares:
        named = ", ".join(f"{n} {percent(s, 0)}" for n, s in shares.items())
        determined = f"determined, by priors: {named}"
    adequate = f"no: {'; '.join(fit.denials)}" if fit.denials else fit.adequate_in_words
    untrusted = fit.untrusted
    trusted = f"not trusted: {', '.join(untrusted)}" if untrusted else "trusted"
    lines = (
        ("identifiability", "all parameters", "determined", fit.verdict.identifiable, determined),
        ("trust", "all parameters", "trusted", not untrusted, trusted),
        ("adequacy", "the model", "not no", fit.adequate, adequate),
    )
    return [
        Gate(what, of, math.nan, "", gate, passed, words=words)
        for what, of, gate, passed, words in lines
    ]


def _of_parameter(name: str, estimate: Estimate, *, own_prior: bool) -> list[Gate]:
    def share(sd: float | None) -> float:
        # An estimate of exactly zero has no relative deviation.
        return 100.0 * abs(sd / estimate.value) if sd is not None and estimate.value else math.nan

    remark = "" if estimate.sd is not None else "the data do not determine it"
    wider = estimate.sd is not None and estimate.sd != estimate.sd_white
    lines = [
        _most(
            "Cramér-Rao",
            name,
            share(estimate.sd),
            "%",
            CRAMER_RAO,
            remark or ("allows for autocorrelated residuals" if wider else ""),
        ),
        # Tischler's insensitivity: the sd that it would have were all other parameters known.
        _most("insensitivity", name, share(estimate.sd_alone), "%", INSENSITIVITY, remark),
    ]
    if estimate.sd is None:
        # Insensitivity would be passed: with all others known the data might determine it. They
        # are not, and a tick beside what is not determined would be read as one for it.
        lines[1] = lines[1]._replace(value=math.nan, passed=False)
    if estimate.prior_share > 0.05:  # less is the weak priors of what is estimated beside it
        remark = "share of the posterior variance that priors explain"
        if not own_prior:
            remark += "; it has none itself: others' priors, weak ones of biases and initial states"
        lines.append(Gate("prior share", name, 100 * estimate.prior_share, "%", "", None, remark))
    return lines


def _of_relations(fit: Fit) -> list[Gate]:
    v = fit.verdict
    lines = [_most("condition number", "all parameters", v.condition, "", ILL_CONDITIONED)]
    if len(v.names) > 1:
        # Without the diagonal, which is one whatever the data are.
        size = np.abs(v.correlation - np.diag(np.diag(v.correlation)))
        i, j = np.unravel_index(int(np.nanargmax(size)), size.shape)
        of, value = f"{v.names[min(i, j)]}, {v.names[max(i, j)]}", float(v.correlation[i, j])
        gate = f"at most {CORRELATION:g} in size"
        missing = {*v.undetermined, *v.without_effect} & {v.names[i], v.names[j]}
        passed = abs(value) <= CORRELATION and not missing
        remark = "the data do not determine both" if missing else ""
        lines.append(Gate(_CORRELATED, of, value, "", gate, passed, remark))
    return lines


def _of_agreement(
    name: str, m: Metrics, source: str, *, judged: bool, fitted_mean: str
) -> list[Gate]:
    of = f"{name}, {source}"
    lines = [
        _least(_VAF, of, m.vaf, "", VAF)._replace(gate=f"at least {percent(VAF, 0)}"),
        _least("NRMSE fit", of, m.nrmse_fit_percent, "%", NRMSE_FIT),
        _most("Theil coefficient", of, m.tic, "", THEIL),
        _most(_BIAS_PART, of, m.bias, "", THEIL_PART),
        _most("Theil variance part", of, m.variance, "", THEIL_PART),
        # What is left to covariance is no fault: ideally all of the error is.
        Gate("Theil covariance part", of, m.covariance, "", "", None),
    ]
    if not judged:
        return [_not_asked(line, "a simulation does not know the disturbance") for line in lines]
    if not fitted_mean:
        return lines
    # Where it cannot fail.
    why = f"{fitted_mean} is estimated on this very flight, so that it is near 0 always"
    return [_not_asked(line, why) if line.what == _BIAS_PART else line for line in lines]


def _mean_is_fitted(fit: Fit) -> str:
    """Reason why the mean of every simulated output is the measured one; empty if it need not
    be."""
    layout = fit.reached.layout
    # Of each flight by itself, those held out included.
    if layout.bias:
        return "a bias"
    outputs = max((len(names) for names in layout.outputs), default=0)
    return "an input offset" if 0 < outputs <= len(layout.offsets) else ""


def _not_asked(line: Gate, why: str) -> Gate:
    """A line that informs; the first reason stays."""
    return line._replace(gate="", passed=None, remark=line.remark or f"not asked: {why}")


def _of_held_out(fit: Fit) -> list[Gate]:
    """Gates of held-out flights in frequency, which need no simulation."""
    lines, held = [], fit.held_out_frequency
    for f in held.flights if held is not None else ():
        of = f"{f.flight}, held out"
        if f.estimates_p_value is not None:
            p, remark = f.estimates_p_value, "chance of as large a difference from the fit's"
            gate = _least("its own estimates, p-value", of, p, "", LEVEL, remark)
            lines.append(gate._replace(words=p_value(p)))
        for n in dict.fromkeys([*f.explained, *f.worse]):
            share, passed = f.explained.get(n, math.nan), n not in f.worse
            line = Gate("explained", f"{n}, {of}", 100 * share, "%", "not below none", passed)
            lines.append(line if passed else line._replace(words="less than none"))
    return lines


def _of_disturbance(fit: Fit) -> list[Gate]:
    lines = []
    for output in fit.adequacy.judged:
        if output.against_disturbance is not None:
            remark = "a simulation knows no disturbance: compared with what the estimated one makes"
            ahead = fit.adequacy.ahead
            kind = "simulated" if ahead is None else f"predicted up to {ahead:g} s ahead"
            of, ratio = f"{output.output}, {kind}", output.against_disturbance
            lines.append(_most("error power over expected", of, ratio, "", EXPECTED, remark))
    return lines


def _of_whiteness(fit: Fit, what: str) -> list[Gate]:
    lines = []
    for name, w in fit.whiteness.items():
        remark = f"{w.lags} lags, {percent(w.outside, 1)} of them outside the 99 % band"
        lines.append(Gate(what, name, w.p_value, "", "at least 0.01", w.white, remark))
    if objective_of(fit.method).noise_model != "spectrum":
        return lines
    why = "not asked: the noise's spectrum is estimated, and need not be white"
    return [line._replace(gate="", passed=None, remark=why) for line in lines]


def _of_coherence(responses: FittedResponses | None) -> list[Gate]:
    """Gates of the most coherent input of each output, in the fitted flights together."""
    every = {} if responses is None else responses.coherence
    remark = "highest mean over an octave"
    return [
        _least("coherence", f"{input} to {output}", value, "", COHERENCE, remark)
        for output, (input, value) in every.items()
    ]
