"""Acceptance card: every gate is present, with the result of its number."""

import dataclasses
import math

import numpy as np

from heli_jax.finding import Finding
from heli_jax.report.card import card, failed, shown, summary


def test_a_sound_fit_passes(sound):
    fit, *_ = sound
    lines = card(fit)
    assert failed(lines) == ()
    asked = {g.what for g in lines}
    assert {
        "identifiability", "trust", "adequacy",
        "Cramér-Rao", "insensitivity", "condition number", "largest correlation", "VAF",
        "NRMSE fit", "Theil coefficient", "Theil variance part",
        "whiteness of residuals, p-value",
    } == asked  # fmt: skip
    by = {(g.what, g.of): g for g in lines}
    for name, estimate in fit.estimates.items():
        assert estimate.sd is not None
        assert math.isclose(by["Cramér-Rao", name].value, 100 * estimate.sd / estimate.value)
        # Knowing the others can only help.
        assert by["insensitivity", name].value <= by["Cramér-Rao", name].value * (1 + 1e-9)


def test_a_correlation_keeps_its_sign_and_the_digits_that_tell_it_from_one(sound):
    fit, *_ = sound
    v = fit.verdict
    correlation = np.array([[1.0, -0.99986], [-0.99986, 1.0]])
    close = dataclasses.replace(fit, verdict=dataclasses.replace(v, correlation=correlation))
    [line] = [g for g in card(close) if g.what == "largest correlation"]
    assert (line.value, line.passed) == (-0.99986, False)
    assert shown(line) == "−0.99986"
    for value, text in ((-1.0, "−1.000000"), (0.42, "+0.420"), (0.9972, "+0.9972")):
        assert shown(line._replace(value=value)) == text


def test_what_is_not_determined_fails(not_identifiable):
    fit, *_ = not_identifiable
    gone = failed(card(fit))
    assert {("Cramér-Rao", n) for n in fit.estimates} <= {(g.what, g.of) for g in gone}
    assert any(g.what == "condition number" for g in gone)
    assert "failed: " in summary(card(fit))


def test_a_card_is_never_passed_beside_a_no(sound):
    fit, *_ = sound
    against = [
        Finding("units.in-doubt", "doubt", "", brief=words, denies=True)
        for words in ("a (in b)", "c")
    ]
    lines = card(dataclasses.replace(fit, findings=tuple(against)))
    assert [(g.what, shown(g)) for g in failed(lines)] == [("adequacy", "no: a (in b); c")]
    assert "failed: adequacy" in summary(lines)


def test_filter_error_has_no_gate_of_agreement(sound):
    # Almost any model predicts one sample ahead, and in gusts no simulation follows the record.
    fit, *_ = sound
    filtered = dataclasses.replace(
        fit, method="filter-error", one_step=fit.metrics, one_step_validation=fit.metrics
    )
    left_out = {g.what for g in card(fit)} - {g.what for g in card(filtered)}
    assert left_out >= {"VAF", "NRMSE fit", "Theil coefficient", "Theil variance part"}


def test_theils_bias_part_is_asked_for_only_where_no_bias_was_estimated(sound):
    fit, *_ = sound
    # Each flight has a bias, so its mean is the measured one.
    assert not [g for g in card(fit) if g.what == "Theil bias part"]
    layout = dataclasses.replace(fit.reached.layout, bias=False, offsets=())
    free = dataclasses.replace(fit, reached=fit.reached._replace(layout=layout))
    centred = [g for g in card(free) if g.what == "Theil bias part"]
    assert centred
