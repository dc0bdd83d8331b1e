"""Is a model adequate: white residuals are, drifts and wrong signs are not, each with a remedy that
exists. Records are made in NumPy."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import scipy.signal

from heli_jax import Fit, Flight, Free, Model, Nuisance, Problem, cli, fit, models
from heli_jax.identification.validation.adequacy import Adequacy, Evidence, assess
from heli_jax.identification.validation.advice import Record
from heli_jax.identification.validation.metrics import metrics, whiteness
from heli_jax.identification.validation.predicts_nothing import predicts_nothing
from heli_jax.report import fit_content
from tests.identification.bench import BENCH, vehicle
from tests.identification.test_filter_error import FREE, made

N, DT = 400, 0.05


class Params(NamedTuple):
    Lp: float
    Ld: float


class State(NamedTuple):
    p: float


class Inputs(NamedTuple):
    d: float


class Outputs(NamedTuple):
    p: float


own = Model(
    "own",
    lambda p, s, u: State(p=p.Lp * s.p + p.Ld * u.d),
    lambda p, s, u: Outputs(p=s.p),
    Params, State, Inputs, Outputs, linear=True,
)  # fmt: skip
rng = np.random.default_rng(5)
D = np.repeat(rng.uniform(-1.0, 1.0, N // 8), 8)
DECAY = np.exp(-2.0 * DT)
P = scipy.signal.lfilter([0.0, 5.0 * (1.0 - DECAY) / 2.0], [1.0, -DECAY], D)
WHITE = rng.standard_normal(N)
SLOW = scipy.signal.lfilter([1.0], [1.0, -0.98], rng.standard_normal(N))
SLOW /= SLOW.std()


def judged(measured, simulated, *, model=own, against=None, errors=None, ahead=None, **how):
    if model is own:
        params, free, inputs, name = Params(-2.0, 5.0), {"Lp": Free(-2.0)}, {"d": D}, "p"
    else:
        params, free, inputs, name = (
            vehicle(BENCH),
            {"Ixx": Free(0.03)},
            {"x_roll": 1e-6 * D},
            "roll",
        )
    flight = Flight(dt=DT, inputs=inputs, outputs={name: measured})
    problem = Problem(model, params, [flight], free, **how)
    record = Record("flight 1", DT, {name: measured}, {name: simulated})
    white = {f"flight 1/{name}": whiteness(measured - simulated)}
    against = None if against is None else {name: against}
    agreement = {name: metrics(measured, simulated)}
    errors = () if errors is None else ({name: errors},)
    evidence = Evidence((record,), agreement, white, against, innovations=errors, ahead=ahead)
    return assess(problem, params, evidence)


def test_white_residuals_are_adequate_whatever_is_explained():
    for measured, simulated in (
        (P + 0.05 * WHITE, P), (0.1 * P + 3.0 * WHITE, 0.1 * P), (WHITE, 0.01 * P),
    ):  # fmt: skip
        found = judged(measured, simulated)
        assert found.adequate
        assert found.summary == "yes"
        assert found.sentences == ()


def test_a_good_fit_with_coloured_residuals_is_adequate_in_size_only():
    found = judged(P + 0.14 * P.std() * SLOW, P)
    assert 0.97 < found.judged[0].vaf < 0.99
    assert not found.judged[0].white
    assert found.adequate
    assert found.summary == "in size only (the residuals of p are not white)"
    worse = judged(P + 0.35 * P.std() * SLOW, P).summary
    assert worse.startswith("in size only (the residuals of p are not white; VAF of p is 8")
    filtered = judged(P + 0.14 * P.std() * SLOW, P, against=1.0)
    assert filtered.summary == "in size only (the innovations of p are not white)"


def test_a_slow_rest_asks_for_filter_error_only_where_there_is_an_axis():
    drift = P + 2.0 * P.std() * SLOW
    found = judged(drift, P)
    assert not found.adequate
    assert "no axis to disturb" in " ".join(found.sentences)
    assert "filter-error" not in " ".join(found.sentences)
    flown = judged(drift, 0.1 * P, model=models.roll_on_stand)
    assert not flown.adequate
    assert "filter-error with disturbance: {axis: roll, poles: 1}" in " ".join(flown.sentences)


def test_a_wrong_sign_is_told_even_where_the_fit_has_shrunk():
    for simulated in (P, 0.001 * P):
        found = judged(-P + 0.01 * WHITE, simulated)
        assert not found.adequate
        [said] = [s for s in found.advice if "moves against" in s]
        assert "signs and columns of p and d" in said


def test_a_late_input_and_a_divergent_simulation_have_remedies_of_their_own():
    late = np.concatenate([np.zeros(8), P[:-8]])
    found = judged(late + 0.3 * SLOW, 0.4 * P)
    assert not found.adequate
    assert any("0.4 s later" in s and "nuisance.time_shift: true" in s for s in found.advice)
    with_shift = judged(late + 0.3 * SLOW, 0.4 * P, nuisance=Nuisance(time_shift=True))
    assert not any("time_shift" in s for s in with_shift.advice)
    diverged = judged(P + 0.01 * WHITE, P + 1e-2 * np.exp(0.03 * np.arange(N)))
    assert diverged.less_than_mean
    assert "less than its mean" in diverged.summary
    assert any("fit.shooting: {window: 2.0}" in s for s in diverged.advice)
    within = judged(P + 0.01 * WHITE, P + 1e-2 * np.exp(0.03 * np.arange(N)), window=2.0)
    assert not any("fit.shooting" in s for s in within.advice)


def test_with_a_disturbance_the_simulation_is_held_against_what_it_makes():
    disturbed = P + 1.3 * P.std() * SLOW
    small, as_expected = judged(disturbed, P, against=30.0), judged(P + 3.0 * WHITE, P, against=1.2)
    assert not small.adequate
    assert "5.5 times what the estimated disturbance explains" in small.reasons[0]
    assert as_expected.adequate
    # Innovations that are far from white: the filter does not predict what it says.
    assert not judged(P + 3.0 * P.std() * SLOW, P, against=1.2).adequate


def test_filter_error_that_simulates_worse_than_the_mean_is_adequate_one_step_ahead_only():
    # A simulation that has nothing of the measured output in it, with a difference that is white.
    other = np.random.default_rng(9).standard_normal(N)
    found = judged(WHITE, 0.9 * other, against=1.2, errors=WHITE)
    assert found.adequate
    assert not found.less_than_mean
    assert found.summary.startswith("one step ahead only (VAF of p, simulated, is -")
    assert "less than its mean" in found.summary


@pytest.mark.parametrize(("left", "named"), [(1.0, True), (0.95, True), (0.5, False)])
def test_a_filter_that_predicts_no_better_than_the_mean_explains_nothing(left, named):
    # `left`: the error of the prediction over white noise, of which nothing can be foretold.
    measured = WHITE - WHITE.mean()
    found = judged(measured, 0.01 * np.roll(measured, 7), against=1.2, errors=left * measured)
    assert found.adequate
    assert ("but nothing of p is explained" in found.summary) == named


def test_a_filter_that_only_repeats_the_sample_before_explains_nothing():
    walk = np.cumsum(WHITE)
    for ahead, named in ((np.diff(walk, prepend=0.0), True), (0.3 * WHITE, False)):
        found = judged(walk, np.zeros(N), against=1.2, errors=ahead)
        assert ("nothing of p" in " ".join(found.sentences)) == (found.adequate and named)
        assert predicts_nothing([(walk, ahead)]) == named


@pytest.mark.slow
def test_an_unstable_machine_is_judged_by_what_is_predicted_ahead():
    good = judged(P + 0.05 * WHITE, P, against=1.0, ahead=2.0)
    assert good.adequate
    assert good.summary == "yes"
    assert good.ahead == 2.0
    assert "predictions up to 2 s ahead" in good.sentences[0]
    assert not any("Driven by the inputs alone" in sentence for sentence in good.sentences)
    bad = judged(P + 5.0 * SLOW, P, against=20.0, ahead=2.0)
    assert not bad.adequate
    assert "predicted up to 2 s ahead misses" in bad.reasons[0]


@pytest.mark.slow
def test_filter_error_does_not_hide_an_input_of_the_wrong_sign(bench30):
    model, _, start, flight = made(bench30, 3)
    right = fit(Problem(model, start, [flight], FREE, method="filter-error"))
    assert right.adequate
    assert 0.2 < right.adequacy.judged[0].against_disturbance < 5.0
    turned = Flight(
        dt=flight.dt, inputs={"x_roll": -flight.inputs["x_roll"]}, outputs=flight.outputs
    )
    wrong = fit(Problem(model, start, [turned], FREE, method="filter-error"))
    assert not wrong.adequate
    assert any("moves against the measured one" in note for note in wrong.notes)


@pytest.mark.parametrize(
    ("status", "less", "held_out", "code"),
    [
        ("converged", False, (), 0), ("converged", True, (), 4), ("converged", False, ("p",), 4),
        ("not-identifiable", True, ("p",), 3), ("not-converged", True, (), 4),
        ("converged", False, "by another method", 3),
    ],
)  # fmt: skip
def test_exit_codes(status, less, held_out, code):
    adequacy = SimpleNamespace(reasons=("VAF of p is -586",) if less else (), less_than_mean=less)
    borne_out = held_out != "by another method"
    fitted = SimpleNamespace(
        status=status,
        adequacy=adequacy,
        held_out_worse=held_out if borne_out else (),
        not_borne_out=() if borne_out else ("Kr",),
    )
    assert cli._fit_code(fitted) == code


@pytest.mark.parametrize(
    ("method", "vaf", "worse"),
    [
        ("output-error", -0.3, ("p",)), ("output-error", np.nan, ("p",)),
        ("output-error", -0.05, ()), ("output-error", 0.4, ()),
        ("filter-error", -0.3, ()), ("frequency-error", -0.3, ()),
    ],
)  # fmt: skip
def test_flights_held_out_are_held_against_their_mean_by_output_error_alone(method, vaf, worse):
    """Gusts and an unstable machine make a simulation in time what it is with the others."""
    metrics = {"p": SimpleNamespace(vaf=vaf)}
    fitted: Any = SimpleNamespace(method=method, validation=metrics, held_out_frequency=None)
    assert Fit.held_out_worse.fget(fitted) == worse  # pyright: ignore[reportOptionalCall]


def test_what_stopped_before_an_optimum_was_not_judged():
    stopped = Adequacy(True, False, (), limited="some of it", at_optimum=False)
    assert stopped.summary == "not judged"
    written = fit_content.adequacy(stopped)
    assert written["adequate"] is None
    assert written["summary"] == "not judged"
    # Nor is it where it looks bad: the numbers there are those of no model.
    assert stopped.doubted(["p is off"]).summary == "not judged"
