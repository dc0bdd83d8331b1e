"""Adequacy of models: white residuals are adequate, drifts and wrong signs are not."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from heli_jax.finding import Distrust, Finding, distrusted, exit_code, rated
from heli_jax.identification.diagnostics import residuals
from heli_jax.identification.diagnostics.context import HeldOut
from heli_jax.identification.validation.adequacy import assess
from heli_jax.identification.validation.metrics import metrics, whiteness
from tests.identification.lag import response

N, DT = 400, 0.05


rng = np.random.default_rng(5)
D = np.repeat(rng.uniform(-1.0, 1.0, N // 8), 8)
P = response(-2.0, 5.0, D, DT)
WHITE = rng.standard_normal(N)
SLOW = scipy.signal.lfilter([1.0], [1.0, -0.98], rng.standard_normal(N))
SLOW /= SLOW.std()


def judged(measured, simulated, *, against=None, ahead=None):
    pairs = [({"p": measured}, {"p": simulated})]
    agreement = {"p": metrics(measured, simulated)}
    white = {"flight 1/p": whiteness(measured - simulated)}
    against = None if against is None else {"p": against}
    return Judged(assess(pairs, agreement, white, against, ahead))


class Judged:
    """Return a fit with the fields that adequacy needs."""

    fitted, free = True, ("Lp",)

    def __init__(self, adequacy):
        self.adequacy = adequacy

    @property
    def findings(self):
        return list(residuals.outputs_explained(self))


def denied(found):
    return [f.subjects for f in found.findings if f.denies]


def test_white_residuals_are_adequate_whatever_is_explained():
    for measured, simulated in ((P + 0.05 * WHITE, P), (WHITE, 0.01 * P)):
        assert judged(measured, simulated).findings == []


def test_a_good_fit_with_coloured_residuals_is_adequate():
    found = judged(P + 0.14 * P.std() * SLOW, P)
    assert 0.97 < found.adequacy.judged[0].vaf < 0.99
    assert not found.adequacy.judged[0].white
    assert found.findings == []
    assert judged(P + 0.14 * P.std() * SLOW, P, against=1.0).findings == []


@pytest.mark.parametrize(
    ("measured", "simulated"),
    [
        (P + 2.0 * P.std() * SLOW, P),  # drifts
        (-P + 0.01 * WHITE, P),  # opposite sign
        (-P + 0.01 * WHITE, 0.001 * P),  # and the fit has shrunk
        (np.concatenate([np.zeros(8), P[:-8]]) + 0.3 * SLOW, 0.4 * P),  # late
        (P + 0.01 * WHITE, P + 1e-2 * np.exp(0.03 * np.arange(N))),  # diverges
    ],
)
def test_an_output_that_is_not_explained_denies_the_model(measured, simulated):
    assert denied(judged(measured, simulated)) == [("p",)]


def test_with_a_disturbance_the_simulation_is_held_against_what_it_makes():
    disturbed = P + 1.3 * P.std() * SLOW
    small, as_expected = judged(disturbed, P, against=30.0), judged(P + 3.0 * WHITE, P, against=1.2)
    assert denied(small)
    assert small.adequacy.judged[0].against_disturbance == 30.0
    assert not denied(as_expected)
    # Innovations are far from white: the filter's predictions are wrong.
    assert judged(P + 3.0 * P.std() * SLOW, P, against=1.2).adequacy.denied


def test_filter_error_that_simulates_worse_than_the_mean_is_adequate_by_what_gusts_make():
    # A simulation without any of the measured output, with a white difference.
    other = np.random.default_rng(9).standard_normal(N)
    found = judged(WHITE, 0.9 * other, against=1.2)
    assert not denied(found)
    assert found.adequacy.judged[0].vaf < 0


def test_an_unstable_machine_is_judged_by_what_is_predicted_ahead():
    good = judged(P + 0.05 * WHITE, P, against=1.0, ahead=2.0)
    assert good.findings == []
    assert good.adequacy.ahead == 2.0
    assert judged(P + 5.0 * SLOW, P, against=20.0, ahead=2.0).adequacy.denied


@pytest.mark.parametrize(
    ("status", "adequate", "trusted", "code"),
    [
        ("converged", True, True, 0), ("converged", True, False, 3), ("converged", False, True, 4),
        ("not-identifiable", True, True, 3), ("not-identifiable", False, True, 4),
        ("not-converged", True, True, 4),
    ],
)  # fmt: skip
def test_exit_codes(status, adequate, trusted, code):
    distrusts = {} if trusted else {"Kr": Distrust("loop.feedback", "a loop")}
    assert exit_code(status, adequate, distrusts) == code


def test_a_misfit_takes_away_the_intervals_that_it_moves_by_more_than_half():
    estimates = {
        n: SimpleNamespace(value=2.0, sd=sd) for n, sd in (("a", 1.0), ("b", 1.0), ("c", None))
    }
    small = Finding("x.small", "doubt", "", shifts={"a": -1.95, "b": 0.1, "c": 50.0})
    large = Finding("x.large", "note", "", shifts={"a": -1.97, "b": 0.1}, brief="why")
    assert distrusted([small], estimates) == {}
    assert distrusted([small, large], estimates) == {"a": Distrust("x.large", "why")}
    # It moves correlated parameters too: one step is a size to first order.
    both = large._replace(shifts={"a": -1.97, "b": 1.0})
    assert distrusted([both], estimates)["b"] == Distrust("x.large", "why")
    # The amount is unknown.
    unsized = Finding("x.all", "doubt", "", distrusts=("b", "c"), brief="all")
    assert distrusted([unsized], estimates) == {"b": Distrust("x.all", "all")}
    # A finding without effect is a note; one that contradicts the model stays.
    denies = small._replace(denies=True)
    assert [f.severity for f in rated([small, large, unsized, denies], estimates)] == [
        "note", "doubt", "doubt", "doubt",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("vaf", "worse"), [(-0.3, True), (np.nan, True), (-0.05, False), (0.4, False)]
)
def test_flights_held_out_are_held_against_their_mean(monkeypatch, vaf, worse):
    at = SimpleNamespace(layout=SimpleNamespace(noise_model="white"))
    fitted = SimpleNamespace(at=at, held_out=HeldOut())
    monkeypatch.setattr(residuals, "pooled_metrics", lambda _: {"p": SimpleNamespace(vaf=vaf)})
    found = list(residuals.held_out_predicted(fitted))
    assert [(f.subjects, f.denies) for f in found] == worse * [(("p",), True)]
