"""Acceptance card: the usual limits of rotorcraft identification, each passed or failed.

The first gates are the three statements of a fit, so a card never passes if a statement is `no`.
Gates that cannot fail, or cannot pass, are omitted.
"""

import math
from typing import NamedTuple

import numpy as np

from heli_jax.analysis.spectra import COHERENT
from heli_jax.identification.fit import Estimate, Fit
from heli_jax.identification.methods import objective_of
from heli_jax.identification.validation.adequacy import EXPECTED
from heli_jax.identification.validation.held_out import LEVEL
from heli_jax.identification.validation.metrics import Metrics
from heli_jax.numbers import number, p_value, percent, vaf_percent
from heli_jax.report.fitted_responses import FittedResponses

CRAMER_RAO, INSENSITIVITY, COHERENCE = 20.0, 10.0, COHERENT
"""Limits of Tischler and Remple, Aircraft and Rotorcraft System Identification (2012)."""
CORRELATION = 0.9
"""Limit of Klein and Morelli, Aircraft System Identification (2006)."""
THEIL, THEIL_PART = 0.3, 0.1
"""Limits of Jategaonkar, Flight Vehicle System Identification (2006)."""
VAF, NRMSE_FIT, ILL_CONDITIONED = 0.9, 70.0, 1e4
"""Limits of this program."""
_RESTS = 0.5
"""Share of a variance explained by priors above which the card names the parameter."""
_VAF = "VAF"
_CORRELATED = "largest correlation"


class Gate(NamedTuple):
    """One line of the card."""

    what: str
    of: str
    """Parameter, output or flight."""
    value: float
    """NaN without a value."""
    unit: str
    gate: str
    """Limit in words."""
    passed: bool
    words: str = ""
    """Text that replaces a number."""


def card(fit: Fit, responses: FittedResponses | None = None) -> tuple[Gate, ...]:
    """Return all gates; none for a fit that did not converge."""
    if fit.status == "not-converged":
        return ()
    gates = _of_verdicts(fit)
    for name, estimate in fit.estimates.items():
        gates += _of_parameter(name, estimate)
    gates += _of_relations(fit)
    # With process noise a simulation departs from the record even at the true parameters, and
    # almost any model predicts one sample ahead. A method in frequency simulates nothing.
    noise_model = objective_of(fit.method).noise_model
    if noise_model == "white":
        for metrics, how in ((fit.metrics, "simulated"), (fit.validation, "held out, simulated")):
            for name, m in metrics.items():
                gates += _of_agreement(f"{name}, {how}", m, fitted_mean=_mean_is_fitted(fit))
    gates += _of_held_out(fit)
    gates += _of_disturbance(fit)
    if noise_model != "spectrum":
        errors = "innovations" if noise_model == "disturbance" else "residuals"
        for name, w in fit.whiteness.items():
            what = f"whiteness of {errors}, p-value"
            gates.append(Gate(what, name, w.p_value, "", "at least 0.01", w.white))
    # Each output counts with its most coherent input, over all fitted flights together.
    for output, (input, value) in ({} if responses is None else responses.coherence).items():
        gates.append(_least("coherence", f"{input} to {output}", value, "", COHERENCE))
    return tuple(gates)


def failed(gates: tuple[Gate, ...]) -> tuple[Gate, ...]:
    """Return the failed gates."""
    return tuple(gate for gate in gates if not gate.passed)


def summary(gates: tuple[Gate, ...], most: int | None = None) -> str:
    """Return a summary such as `13 of 15 gates passed; failed: Cramér-Rao of If (34 %)`.

    Args:
        most: largest number of failed gates that are named.
    """
    if not gates:
        return "none, since the optimiser stopped before an optimum"
    missed = failed(gates)
    text = f"{len(gates) - len(missed)} of {len(gates)} gates passed"
    if missed:
        named = missed if most is None else missed[:most]
        words = (f"{gate.what} of {gate.of} ({shown(gate)})" for gate in named)
        text += "; failed: " + ", ".join(words)
        if len(missed) > len(named):
            text += f" and {len(missed) - len(named)} more (report)"
    return text


def shown(gate: Gate) -> str:
    """Return the value as text."""
    if gate.words:
        return gate.words
    if math.isnan(gate.value):
        return "none"
    if gate.what == _VAF:
        return vaf_percent(gate.value)
    text = number(gate.value, 3)
    if gate.what == _CORRELATED:
        # Show two digits of the difference from one.
        missing = max(1.0 - abs(gate.value), 2e-5)
        text = f"{gate.value:+.{max(3, math.ceil(1.0 - math.log10(missing)))}f}"
        text = text.replace("-", "−")
    return f"{text} {gate.unit}" if gate.unit else text


def _most(what: str, of: str, value: float, unit: str, most: float) -> Gate:
    # A NaN compares as False, and so fails.
    return Gate(what, of, value, unit, f"at most {most:g} {unit}".rstrip(), bool(value <= most))


def _least(what: str, of: str, value: float, unit: str, least: float) -> Gate:
    return Gate(what, of, value, unit, f"at least {least:g} {unit}".rstrip(), bool(value >= least))


def _of_verdicts(fit: Fit) -> list[Gate]:
    determined = "determined" if fit.verdict.identifiable else "not determined"
    shares = {n: s for n, s in fit.verdict.prior_share.items() if s > _RESTS}
    if fit.verdict.identifiable and shares:
        named = ", ".join(f"{n} {percent(s, 0)}" for n, s in shares.items())
        determined = f"determined, by priors: {named}"
    adequate = (
        f"no: {'; '.join(fit.reasons_against)}" if fit.reasons_against else fit.adequate_in_words
    )
    untrusted = fit.untrusted
    trusted = f"not trusted: {', '.join(untrusted)}" if untrusted else "trusted"
    rows = (
        ("identifiability", "all parameters", "determined", fit.verdict.identifiable, determined),
        ("trust", "all parameters", "trusted", not untrusted, trusted),
        ("adequacy", "the model", "adequate", fit.adequate, adequate),
    )
    return [
        Gate(what, of, math.nan, "", gate, passed, words) for what, of, gate, passed, words in rows
    ]


def _of_parameter(name: str, estimate: Estimate) -> list[Gate]:
    def share(sd: float | None) -> float:
        # The gate fails without an sd, and for an estimate of exactly zero.
        if sd is None or estimate.sd is None or not estimate.value:
            return math.nan
        return 100.0 * abs(sd / estimate.value)

    return [
        _most("Cramér-Rao", name, share(estimate.sd), "%", CRAMER_RAO),
        _most("insensitivity", name, share(estimate.sd_alone), "%", INSENSITIVITY),
    ]


def _of_relations(fit: Fit) -> list[Gate]:
    v = fit.verdict
    gates = [_most("condition number", "all parameters", v.condition, "", ILL_CONDITIONED)]
    if len(v.names) > 1:
        size = np.abs(v.correlation - np.diag(np.diag(v.correlation)))
        i, j = np.unravel_index(int(np.nanargmax(size)), size.shape)
        of, value = f"{v.names[min(i, j)]}, {v.names[max(i, j)]}", float(v.correlation[i, j])
        passed = abs(value) <= CORRELATION and not v.not_identifiable & {v.names[i], v.names[j]}
        limit = f"at most {CORRELATION:g} in size"
        gates.append(Gate(_CORRELATED, of, value, "", limit, passed))
    return gates


def _of_agreement(of: str, m: Metrics, *, fitted_mean: bool) -> list[Gate]:
    gates = [
        _least(_VAF, of, m.vaf, "", VAF)._replace(gate=f"at least {percent(VAF, 0)}"),
        _least("NRMSE fit", of, m.nrmse_fit_percent, "%", NRMSE_FIT),
        _most("Theil coefficient", of, m.tic, "", THEIL),
        _most("Theil variance part", of, m.variance, "", THEIL_PART),
    ]
    if not fitted_mean:
        gates.append(_most("Theil bias part", of, m.bias, "", THEIL_PART))
    return gates


def _mean_is_fitted(fit: Fit) -> bool:
    """True if a bias or an input offset fits the mean of every output."""
    layout = fit.reached.layout
    outputs = max((len(names) for names in layout.outputs), default=0)
    return bool(layout.bias) or 0 < outputs <= len(layout.offsets)


def _of_held_out(fit: Fit) -> list[Gate]:
    """Return gates of held-out flights in frequency, which need no simulation."""
    gates, held = [], fit.held_out_frequency
    for f in held.flights if held is not None else ():
        of = f"{f.flight}, held out"
        if f.estimates_p_value is not None:
            p = f.estimates_p_value
            gate = _least("its own estimates, p-value", of, p, "", LEVEL)
            gates.append(gate._replace(words=p_value(p)))
        for n in dict.fromkeys([*f.explained, *f.worse]):
            share, passed = f.explained.get(n, math.nan), n not in f.worse
            words = "" if passed else "less than none"
            limit = "not below none"
            gates.append(Gate("explained", f"{n}, {of}", 100 * share, "%", limit, passed, words))
    return gates


def _of_disturbance(fit: Fit) -> list[Gate]:
    """Return gates of the error's power relative to the estimated disturbance."""
    ahead = fit.adequacy.ahead
    kind = "simulated" if ahead is None else f"predicted up to {ahead:g} s ahead"
    what = "error power over expected"
    return [
        _most(what, f"{o.output}, {kind}", o.against_disturbance, "", EXPECTED)
        for o in fit.adequacy.judged
        if o.against_disturbance is not None
    ]
