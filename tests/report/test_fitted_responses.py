"""Responses of a fitted model with those of its flights: numbers, figure, page and fit.json."""

import dataclasses

import numpy as np
import pytest

from heli_jax import naming
from heli_jax.analysis.attitude_responses import handling_pairs
from heli_jax.analysis.flight_responses import Settings
from heli_jax.report.card import card
from heli_jax.report.files import SupplementaryAnalyses, fit_json
from heli_jax.report.fit_page import Analysis, drawings, write_report
from heli_jax.report.fitted_responses import NO_RESPONSES, fitted_responses
from heli_jax.report.tables import handling
from tests import responses


@pytest.fixture(scope="module")
def shown(sound):
    fit, problem, _ = sound
    asked = handling_pairs(problem.model, problem.training[0].outputs)
    return fitted_responses(fit, problem, Settings(window=10.0), asked)


def test_the_model_s_response_is_that_of_the_bode_figure_and_moves_with_its_parameters(
    sound, shown
):
    fit, problem, _ = sound
    (pair,) = shown.pairs
    names = (pair.output, pair.input)

    def continuous(params):
        return responses.continuous(problem.model, params, *names)(pair.omega)

    H = continuous(fit.params)
    np.testing.assert_allclose(pair.model.response, H, rtol=1e-9)
    # Its standard deviation, by finite differences along the two estimates.
    steps = []
    for name in ("Ixx", "If"):
        value = fit.estimates[name].value
        moved = naming.replace(fit.params, **{name: value * (1.0 + 1e-6)})
        steps.append(np.log(np.abs(continuous(moved) / H)) / 1e-6)
    sd = np.array([fit.estimates[n].sd / fit.estimates[n].value for n in ("Ixx", "If")])
    covariance = np.outer(sd, sd) * fit.verdict.correlation
    by_hand = np.sqrt(np.einsum("ak,ab,bk->k", steps, covariance, steps))
    # An interval of Student's t is slightly wider than 1.96 standard deviations.
    np.testing.assert_allclose(pair.model.gain_sd, by_hand, rtol=0.01, atol=1e-9)
    # The data agree with the model within their errors, at the frequencies that count.
    good = np.isfinite(pair.H) & (pair.coherence > 0.9)
    z = (pair.H - H)[good] / np.hypot(pair.sd[good], np.abs(H[good]) * pair.model.gain_sd[good])
    assert good.sum() > 10
    assert np.mean(np.abs(np.stack([z.real, z.imag])) < 2.5) > 0.8


def test_they_are_drawn_told_and_written(sound, shown, tmp_path):
    fit, problem, baseline = sound
    supplementary = SupplementaryAnalyses(responses=shown)
    analysis = Analysis(fit, problem, baseline, supplementary)
    (name,) = [n for n in drawings(analysis) if n.startswith("match")]
    chart = drawings(analysis)[name]()
    assert [p.label for p in chart.panels][2:] == ["coherence", "error [dB]", "error [deg]"]
    write_report(tmp_path, analysis, "title", {})
    assert "Handling qualities" in (tmp_path / "report.html").read_text(encoding="utf-8")
    first = handling(shown.handling).rows[0]
    assert (first[0], first[1], first[-1]) == ("x_roll to roll", "bandwidth", "rad/s")
    (content,) = fit_json(fit, problem, baseline, supplementary)["handling_qualities"]
    model, data = (content[s]["numbers"]["phase_bandwidth"] for s in ("model", "data"))
    assert data["lower95"] < model["value"] < data["upper95"]


def test_the_card_asks_each_output_for_a_coherent_input(sound, shown):
    fit, problem, _ = sound
    [gate] = [g for g in card(fit, shown) if g.what == "coherence"]
    assert (gate.of, gate.passed) == ("x_roll to roll", True)
    dead = 0.1 * np.random.default_rng(1).standard_normal(problem.flights[0].n_samples)
    flight = dataclasses.replace(problem.flights[0], outputs={"roll": dead})
    of_noise = fitted_responses(
        fit, dataclasses.replace(problem, flights=(flight,)), Settings(window=10.0), ()
    )
    [gate] = [g for g in card(fit, of_noise) if g.what == "coherence"]
    assert gate.passed is False
    assert of_noise.incoherent == ("x_roll to roll",)


def test_flights_that_are_too_short_say_so(sound):
    fit, problem, _ = sound
    told = fitted_responses(fit, problem, Settings(window=100.0), ())
    assert told.pairs == ()
    assert [n.code for n in told.notes] == [NO_RESPONSES]
