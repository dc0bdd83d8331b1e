"""Every run of a search is a row of `Fit.starts` with its reason; one rule chooses."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from heli_jax import Free, Nuisance, Problem, fit
from heli_jax.identification import search
from heli_jax.identification.restarts import RESTARTS
from tests.identification.test_equation_error import ROLL, Params, record


def test_names_are_codes_and_stand_once():
    names = [restart.name for restart in RESTARTS]
    assert len(set(names)) == len(names)
    assert all(name == name.lower() and " " not in name for name in names)


def test_a_damping_of_the_wrong_sign_is_found_by_windows():
    # For a linear model equation error would be enough.
    model = dataclasses.replace(ROLL, linear=False)
    flight = record(n=300, noise=2e-3)
    free = {"Lp": Free(4.0), "Lda": Free(9.0)}
    found = fit(Problem(model, Params(4.0, 25.0, 0.0), [flight], free, Nuisance(True, True)))
    assert found.status == "converged"
    assert found.estimates["Lp"].value == pytest.approx(-4.0, abs=0.1)
    first, *others = found.starts
    assert (first.reason, first.chosen) == ("by-windows", True)
    assert [(row.reason, row.chosen) for row in others] == [("start", False)]
    assert not others[0].converged
    assert "search.by-windows" in {f.code for f in found.findings}


def test_where_little_is_explained_equation_error_gives_a_start():
    flight = record(n=1500, noise=2e-3)
    free = {"Lp": Free(4.0), "Lda": Free(9.0)}
    found = fit(Problem(ROLL, Params(4.0, 25.0, 0.0), [flight], free, Nuisance(True, True)))
    assert found.status == "converged"
    assert found.starts[0].reason == "further-starts"
    regressed = [row for row in found.starts if row.start["Lp"] == pytest.approx(-4.0, abs=0.1)]
    assert [row.start["Lda"] for row in regressed] == [pytest.approx(25.0, rel=0.05)]


def test_convergence_then_stability_then_the_posterior_decide(monkeypatch):
    monkeypatch.setattr(search, "lost_stability", lambda over, optimum: optimum.unstable)
    monkeypatch.setattr(search, "log_posterior", lambda over, optimum: optimum.posterior)
    over = SimpleNamespace(layout=SimpleNamespace(model=SimpleNamespace(linear=True)))

    def optimum(converged, unstable, posterior):
        best = SimpleNamespace(converged=np.asarray(converged))
        return SimpleNamespace(best=best, unstable=unstable, posterior=posterior)

    ranked = [
        optimum(True, False, 5.0),
        optimum(True, False, 4.0),
        optimum(True, True, 9.0),
        optimum(False, False, 99.0),
    ]
    for i, better in enumerate(ranked):
        for worse in ranked[i + 1 :]:
            assert search.is_better(over, better, worse)
            assert not search.is_better(over, worse, better)
    # Without a difference the first result stays.
    assert not search.is_better(over, optimum(True, False, 4.05), ranked[1])
