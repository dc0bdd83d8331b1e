"""What fit.json holds of each part of a fit, as plain data."""

from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.analysis.response_agreement import USUAL_J, ResponseAgreement
from heli_jax.finding import as_data
from heli_jax.flights import Flight
from heli_jax.flights.origins import as_content
from heli_jax.identification.agreement import COLOURED
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.equation_error.first_guess import EquationErrorStart
from heli_jax.identification.fit import Estimate, Fit, Status
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.model_selection import Choice
from heli_jax.identification.problem import Problem
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.validation.adequacy import EXPECTED, EXPLAINED, NEARLY_WHITE
from heli_jax.identification.validation.follows_response import LEVEL
from heli_jax.identification.validation.held_out_agreement import HeldOutFrequency


def whiteness_note(fit: Fit) -> str:
    """What coloured residuals do to the intervals; empty where the residuals are white."""
    return next((f.sentence for f in fit.findings if f.code == COLOURED), "")


def residuals(fit: Fit) -> dict[str, Any]:
    """Whether they are white, and whether inputs follow what they stand for."""
    whiteness = {name: w._asdict() for name, w in fit.whiteness.items()}
    return {
        "residuals": {
            "white": fit.white,
            "overconfident": fit.overconfident,
            "note": whiteness_note(fit),
            "by_output": whiteness,
        },
        "feedback": [{**f._asdict(), "present": f.present, "level": LEVEL} for f in fit.feedback],
        "untrusted": {n: d._asdict() for n, d in fit.distrusts.items()},
        "distrust": fit.distrust,
    }


def responses(agreement: ResponseAgreement | None) -> dict[str, Any] | None:
    """Measured frequency responses and the model's, where these were fitted."""
    if agreement is None:
        return None
    return {
        **agreement._asdict(),
        "averages": dict(agreement.averages),
        "pairs": [p._asdict() for p in agreement.pairs],
        "usual_J": USUAL_J,
    }


def held_out_frequency(held: HeldOutFrequency | None) -> dict[str, Any] | None:
    """What flights held out say in frequency."""
    if held is None:
        return None
    return {
        "flights": [
            {
                **f._asdict(),
                "furthest": f.furthest._asdict() if f.furthest else None,
                "responses": responses(f.responses),
            }
            for f in held.flights
        ],
        "bands": [b._asdict() for b in held.bands],
        "notes": list(held.notes),
    }


def first_guess(problem: Problem) -> dict[str, Any] | None:
    """How the starts were found: where the fit began, not its result."""
    guess = problem.first_guess
    # Not the fit's own `starts`: here stands how the first of them was found, with the noise's bias
    # that such values have.
    if not isinstance(guess, EquationErrorStart):
        return None
    selection = guess.selection
    return {
        "values": {n: v._asdict() for n, v in guess.values.items()},
        "equations": [e._asdict() for e in guess.equations],
        "smoothing_half_width_s": guess.half_width,
        "not_measured": list(guess.hidden),
        "stepwise": None
        if selection is None
        else {
            "selected": list(selection.selected),
            "steps": [s._asdict() for s in selection.steps],
            "f_ratios": selection.f_ratios,
        },
        "sentences": list(guess.sentences),
    }


def metrics(fit: Fit) -> dict[str, Any]:
    """Agreement by output, of the fitted flights and of those held out."""
    return {
        "metrics": {n: m._asdict() for n, m in fit.metrics.items()},
        "validation": {n: m._asdict() for n, m in fit.validation.items()},
        "validation_free_run": {n: m._asdict() for n, m in fit.validation_free_run.items()},
        "one_step": {n: m._asdict() for n, m in fit.one_step.items()},
        "one_step_validation": {n: m._asdict() for n, m in fit.one_step_validation.items()},
    }


def likelihood(fit: Fit) -> dict[str, Any]:
    """Log-likelihood, how many unknowns it took, and the criteria of both."""
    return {
        "log_likelihood": fit.log_likelihood,
        "unknowns": fit.unknowns,
        "aic": fit.aic,
        "bic": fit.bic,
    }


def adequacy(fit: Fit) -> dict[str, Any]:
    """Whether the model explains what was measured."""
    return {
        "summary": fit.adequate_in_words,
        "judged": [output._asdict() for output in fit.adequacy.judged],
        "by_chance": fit.adequacy.by_chance,
        "ahead": fit.adequacy.ahead,
        # The limits of this version: a later one may have others.
        "against": {
            "explained_at_least": EXPLAINED,
            "or_other_than_white_noise_at_most": NEARLY_WHITE,
            "or_power_over_what_the_disturbance_makes_at_most": EXPECTED,
        },
    }


def choice(choice: Choice | None) -> dict[str, Any] | None:
    """The models compared."""
    if choice is None:
        return None
    return {
        "candidates": [c._asdict() for c in choice.candidates],
        "nested": [t._asdict() for t in choice.nested],
        "sentences": list(choice.sentences),
    }


def intervals(comparison: Intervals | None) -> dict[str, Any] | None:
    """Intervals by several methods."""
    if comparison is None:
        return None
    content: dict[str, Any] = {
        "by_parameter": comparison.by_parameter,
        "profiles": {n: p._asdict() for n, p in comparison.profiles.items()},
        "sentences": list(comparison.sentences),
    }
    # Of replicates and draws the counts and diagnostics alone: themselves they are megabytes.
    if comparison.bootstrap is not None:
        content["bootstrap_failures"] = comparison.bootstrap.failures
    if comparison.posterior is not None:
        p = comparison.posterior
        content["nuts"] = {
            "rhat": p.rhat,
            "effective": p.effective,
            "divergent": p.divergent,
            "trusted": p.trusted,
            "by_parameter": {n: c._asdict() for n, c in p.convergence.items()},
        }
    return content


def parameter(e: Estimate, status: Status = "converged") -> dict[str, Any]:
    """One estimate of a fit; of what the data do not determine the guess and the bounds alone."""
    # The status says that it is no result: whoever goes on from there has to know where it is.
    if status == "not-converged":
        return {**e._asdict(), "fixed": False}
    # Where the optimiser stopped in a direction that nothing determines is an accident, and a
    # program that reads the file would take it for an estimate.
    missing = dict.fromkeys(("value", "sd_white", "sd_alone")) if e.sd is None else {}
    return {**e._asdict(), **missing, "fixed": False}


def starts(fit: Fit) -> list[dict[str, Any]]:
    """Where each start led; null for what is not determined."""
    arrived = fit.status != "not-converged"
    open_ones = {n for n, e in fit.estimates.items() if arrived and e.sd is None}
    return [
        {**row._asdict(), "end": {n: None if n in open_ones else v for n, v in row.end.items()}}
        for row in fit.starts
    ]


def fixed(problem: Problem) -> dict[str, Any]:
    """The parameters a user might look for that were not free: those that flights replace."""
    names = {n for f in problem.flights for n in f.known}
    # A list, since each flight may have a value of its own; null where it has none.
    return {
        n: {"value": [f.known.get(n) for f in problem.flights], "fixed": True}
        for n in sorted(names)
    }


def constants(fit: Fit, problem: Problem) -> dict[str, float]:
    """The vehicle's numbers that the fit took as known [SI]: those that no flight replaces."""
    others = {*fit.estimates, *fit.nuisance, *fixed(problem)}
    params = {n: np.asarray(v) for n, v in naming.asdict(fit.params).items() if n not in others}
    # A model of a user's own may have parameters that are no single numbers.
    return {n: float(v) for n, v in params.items() if v.size == 1 and v.dtype.kind in "fiu"}


def combinations(verdict: Verdict) -> list[dict[str, Any]]:
    """What the data determine where they do not determine every parameter."""
    return [c._asdict() for c in verdict.combinations]


def verdict(verdict: Verdict) -> dict[str, Any]:
    """What the data determine, with all that it was read off."""
    # The covariance and the correlation have no names of their own: `names` is their order.
    return {
        "text": verdict.text,
        "identifiable": verdict.identifiable,
        "rank": verdict.rank,
        "rank_without_priors": verdict.rank_without_priors,
        "condition_number": verdict.condition,
        "singular_values": verdict.singular_values,
        "null_directions": list(verdict.null_directions),
        "determined_combinations": combinations(verdict),
        "strong_pairs": [p._asdict() for p in verdict.pairs],
        "without_effect": list(verdict.without_effect),
        "resting_on_priors": list(verdict.resting),
        "exchangeable_nuisances": list(verdict.exchangeable),
        "other_solutions": [other.values for other in verdict.second],
        "names": list(verdict.names),
        "correlation": verdict.correlation,
        "covariance_log": verdict.covariance,
    }


def baseline(b: Baseline | None) -> dict[str, Any] | None:
    """The recursive least squares."""
    if b is None:
        return None
    return {
        "flight": b.flight,
        "input": b.input,
        "output": b.output,
        "order": b.order,
        "forgetting": b.forgetting,
        "theta": b.theta,
        # JSON has no complex numbers: real and imaginary part.
        "poles": [[float(p.real), float(p.imag)] for p in b.poles],
        "continuous": {
            "num": b.continuous_num,
            "den": b.continuous_den,
            "exact": b.exact,
            "note": b.note,
        },
        "combinations": b.combinations,
        "metrics": {b.output: b.metrics._asdict()},
        "trusted": b.trusted,
        "sentences": list(b.sentences),
    }


def holds(flight: Flight) -> dict[str, dict[str, str]]:
    """By input what it is taken to do between samples, and what of the log spoke for it."""
    reason = flight.hold_reason
    return {n: {"hold": h, "reason": reason.get(n, "as stated")} for n, h in flight.hold.items()}


def source(flight: Flight) -> dict[str, Any]:
    """Where a flight came from."""
    # A flight that was given in memory: `null`, so that nobody looks for a file.
    if flight.source is None:
        return {
            "path": None,
            "sha256": None,
            "flight": flight.name,
            "hold_out": flight.hold_out,
            "n_samples": flight.n_samples,
            "dt": flight.dt,
        }
    return {
        "path": flight.source.path,
        "sha256": flight.source.sha256,
        "flight": flight.name,
        "hold_out": flight.hold_out,
        "n_samples": flight.n_samples,
        "dt": flight.dt,
        "window": list(flight.window),
        "log_first_time": flight.source.first_time,
        "notes": [as_data(n) for n in flight.source.notes],
        "signals": {
            "inputs": {n: as_content(s) for n, s in flight.source.inputs.items()},
            "outputs": {n: as_content(s) for n, s in flight.source.outputs.items()},
        },
    }
