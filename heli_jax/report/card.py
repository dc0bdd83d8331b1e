"""The acceptance card: the usual gates of rotorcraft identification, each passed or failed."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.identification.fit import Estimate, Fit
from heli_jax.identification.identifiability.analysis import ILL_CONDITIONED
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.adequacy import EXPECTED
from heli_jax.identification.validation.metrics import Metrics
from heli_jax.report import frequency
from heli_jax.report.coherence import COHERENT, Coherence, coherences
from heli_jax.report.frequency import FittedFlight

CRAMER_RAO, INSENSITIVITY, COHERENCE = 20.0, 10.0, COHERENT
"""Tischler and Remple, Aircraft and Rotorcraft System Identification (2012)"""
CORRELATION = 0.9
"""Klein and Morelli, Aircraft System Identification (2006)"""
THEIL, THEIL_PART = 0.3, 0.1
"""Jategaonkar, Flight Vehicle System Identification (2006)"""
VAF, NRMSE_FIT = 0.9, 70.0


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


def card(problem: Problem, fit: Fit) -> tuple[Gate, ...]:
    """Every line: parameters, their relations, agreement, whiteness, excitation."""
    lines: list[Gate] = []
    for name, one in fit.estimates.items():
        lines += _of_parameter(name, one)
    lines += _of_relations(fit)
    estimator = estimator_of(fit.method)
    filtered = estimator.process_noise
    for name, m in fit.metrics.items():
        lines += _of_agreement(name, m, "simulated", judged=not filtered)
    for name, m in fit.one_step.items():
        lines += _of_agreement(name, m, "one step ahead", judged=True)
    for name, m in fit.validation.items():
        lines += _of_agreement(name, m, "held out, simulated", judged=not filtered)
    for name, m in fit.one_step_validation.items():
        lines += _of_agreement(name, m, "held out, one step ahead", judged=True)
    for one in fit.adequacy.judged:
        if one.against_disturbance is not None:
            said = "a simulation knows no disturbance: judged against what the estimated one makes"
            of, ratio = f"{one.output}, simulated", one.against_disturbance
            lines.append(_most("error power over expected", of, ratio, "", EXPECTED, said))
    what = estimator.errors
    for name, w in fit.whiteness.items():
        remark = f"{w.lags} lags, {w.outside:.1%} of them outside the 99 % band"
        gate = Gate(
            f"whiteness of {what} (p)", name, w.p_value, "", "at least 0.01", w.white, remark
        )
        lines.append(gate)
    lines += _of_excitation(problem, fit)
    return tuple(lines)


def failed(lines: tuple[Gate, ...]) -> tuple[Gate, ...]:
    """The gates that are not passed."""
    return tuple(one for one in lines if one.passed is False)


def summary(lines: tuple[Gate, ...]) -> str:
    """`13 of 15 gates passed; failed: Cramér-Rao of If (34 %)`."""
    asked, lost = [one for one in lines if one.passed is not None], failed(lines)
    text = f"{len(asked) - len(lost)} of {len(asked)} gates passed"
    if lost:
        text += "; failed: " + ", ".join(f"{one.what} of {one.of} ({shown(one)})" for one in lost)
    return text


def shown(one: Gate) -> str:
    """The value as text."""
    if math.isnan(one.value):
        return "none"
    text = f"{one.value:.3g}"
    return f"{text} {one.unit}" if one.unit else text


def _most(what: str, of: str, value: float, unit: str, most: float, remark: str = "") -> Gate:
    gate = f"at most {most:g}{f' {unit}' if unit else ''}"
    return Gate(what, of, value, unit, gate, bool(value <= most), remark)


def _least(what: str, of: str, value: float, unit: str, least: float, remark: str = "") -> Gate:
    gate = f"at least {least:g}{f' {unit}' if unit else ''}"
    return Gate(what, of, value, unit, gate, bool(value >= least), remark)


def _of_parameter(name: str, one: Estimate) -> list[Gate]:
    def share(sd: float | None) -> float:
        return 100.0 * abs(sd / one.value) if sd is not None and one.value else math.nan

    remark = "" if one.sd is not None else "the data do not determine it"
    wider = one.sd is not None and one.sd != one.sd_white
    lines = [
        _most(
            "Cramér-Rao",
            name,
            share(one.sd),
            "%",
            CRAMER_RAO,
            remark or ("allows for coloured residuals" if wider else ""),
        ),
        _most("insensitivity", name, share(one.sd_alone), "%", INSENSITIVITY, remark),
    ]
    if one.prior_share > 0.05:  # less is the weak priors of what is estimated beside it
        said = "how much of what is known came from the prior"
        lines.append(Gate("prior share", name, 100 * one.prior_share, "%", "", None, said))
    return lines


def _of_relations(fit: Fit) -> list[Gate]:
    v = fit.verdict
    lines = [_most("condition number", "all parameters", v.condition, "", ILL_CONDITIONED)]
    if len(v.names) > 1:
        size = np.abs(v.correlation - np.diag(np.diag(v.correlation)))
        i, j = np.unravel_index(int(np.nanargmax(size)), size.shape)
        of = f"{v.names[min(i, j)]}, {v.names[max(i, j)]}"
        lines.append(_most("largest correlation", of, float(size[i, j]), "", CORRELATION))
    return lines


def _of_agreement(name: str, m: Metrics, how: str, *, judged: bool) -> list[Gate]:
    of = f"{name}, {how}"
    lines = [
        _least("VAF", of, m.vaf, "", VAF),
        _least("NRMSE fit", of, m.nrmse_fit_percent, "%", NRMSE_FIT),
        _most("Theil coefficient", of, m.tic, "", THEIL),
        _most("Theil bias part", of, m.bias, "", THEIL_PART),
        _most("Theil variance part", of, m.variance, "", THEIL_PART),
        Gate("Theil covariance part", of, m.covariance, "", "", None),
    ]
    if judged:
        return lines
    said = "a simulation does not know the disturbance: see its error over what is expected"
    return [one._replace(gate="", passed=None, remark=said) for one in lines]


def _of_excitation(problem: Problem, fit: Fit) -> list[Gate]:
    """Coherence, asked for where the model says that the output follows the input, and told
    elsewhere."""
    lines = []
    # In the order of the signals.
    flights = (*problem.training, *(f for f in problem.flights if f.hold_out))
    for s, flight in zip(fit.signals, flights, strict=False):
        here = {n: jnp.asarray(v) for n, v in flight.known.items()}
        params = naming.replace(fit.params, **here)
        at = frequency.at_record(FittedFlight(problem.model, params, fit, s))
        for (u, y), found in coherences(problem.model, params, at, s, fit).items():
            lines.append(_of_coherence(f"{u} to {y}, {s.flight}", found))
    return lines


def _of_coherence(of: str, found: Coherence | str) -> Gate:
    if isinstance(found, str):
        return Gate("coherence", of, math.nan, "", "", None, found)
    said = f"weighted by the expected response, {found.segments} segments"
    what = "partial coherence" if found.others else "coherence"
    if not found.asked:
        said = f"not asked: the model puts {found.share:.0%} of this output down to this input"
    elif found.expected < COHERENCE:
        said = f"not asked: in the simulation it is {found.expected:.2g} too"
    else:
        return _least(what, of, found.value, "", COHERENCE, said)
    return Gate(what, of, found.value, "", "", None, said)
