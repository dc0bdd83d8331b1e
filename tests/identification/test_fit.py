"""Fits of records from an independent program, started away from the truth."""

import dataclasses

import numpy as np
import pytest

from heli_jax import Flight, Free, Nuisance, Prior, Problem, fit, models
from tests.identification.bench import (
    BENCH,
    record,
    response,
    stable_geometry,
    steps,
    vehicle,
)

IXX = Free(0.05, 0.001, 1.0)
IF = Free(5e-4)
A = Free(5.0)
THREE = {"Ixx": IXX, "If": IF, "a": A}
RESTING = THREE | {"a": Free(4.0, prior=Prior(5.1, 0.3))}
N = 1000
"""Samples; equal to other modules, which then share compiled programs."""


def started(v, factor_ixx=2.0, factor_if=0.4):
    return {"Ixx": Free(v["Ixx"] * factor_ixx), "If": Free(v["If"] * factor_if)}


@pytest.mark.parametrize(
    ("seed", "rate", "stand"), [(1, 50.0, True), (2, 100.0, True), (3, 50.0, False)]
)
def test_recovers_inertias_of_random_machines(seed, rate, stand):
    v = stable_geometry(seed)
    flight = record(v, seed=seed, n=N if stand else 4000, dt=1.0 / rate, stand=stand)
    model = models.roll_on_stand if stand else models.roll
    found = fit(Problem(model, vehicle(v), [flight], started(v)))
    assert found.status == "converged"
    for name in ("Ixx", "If"):
        e = found.estimates[name]
        assert abs(e.value - v[name]) < 4.0 * e.sd
        assert abs(e.value / v[name] - 1.0) < 0.01
    assert found.noise["flight 1/roll"] == pytest.approx(2e-3, rel=0.1)
    assert found.metrics["roll"].vaf > 0.999


@pytest.fixture(scope="module")
def bench_run():
    return record(BENCH, seed=11, n=N)


@pytest.fixture(scope="module")
def alone(bench_run):
    return fit(Problem(models.roll_on_stand, vehicle(BENCH), [bench_run], started(BENCH)))


def test_three_free_are_not_identifiable(bench_run):
    found = fit(Problem(models.roll_on_stand, vehicle(BENCH), [bench_run], THREE))
    assert found.status == "not-identifiable"
    [null] = found.verdict.null_directions
    assert np.allclose([null["Ixx"], null["If"], null["a"]], 3**-0.5, atol=1e-3)
    ratios = {c.name: c for c in found.verdict.combinations}
    assert set(ratios) == {"a/Ixx", "a/If"}
    for name, below in (("a/Ixx", "Ixx"), ("a/If", "If")):
        truth = BENCH["a"] / BENCH[below]
        assert abs(ratios[name].value - truth) < 4.0 * ratios[name].sd
        assert ratios[name].value == pytest.approx(truth, rel=0.01)
    assert all(e.sd is None and e.lower95 is None for e in found.estimates.values())
    assert found.verdict.rank == 2


@pytest.fixture(scope="module")
def resting(bench_run):
    return fit(Problem(models.roll_on_stand, vehicle(BENCH), [bench_run], RESTING))


def test_prior_on_a_makes_it_well_posed(resting):
    found = resting
    assert found.status == "converged"
    a = found.estimates["a"]
    assert a.prior_share > 0.95
    # Ixx and If are determined by the prior of a: their variances are its, apart from those of
    # a/Ixx and a/If.
    for name in ("Ixx", "If"):
        relative = found.estimates[name].sd / found.estimates[name].value
        wanted = a.prior_share * (a.sd / a.value / relative) ** 2
        assert found.estimates[name].prior_share == pytest.approx(wanted, rel=0.05)
        assert 0.5 < wanted < 1.0
    assert 0.25 < a.sd < 0.35
    for name in ("Ixx", "If"):
        assert abs(found.estimates[name].value - BENCH[name]) < 4.0 * found.estimates[name].sd
    assert set(found.verdict.resting) == set(THREE)
    assert found.verdict.rank_without_priors == 2


def test_ratios_that_the_data_alone_determine_have_their_own_intervals(resting, alone):
    found = resting
    assert set(found.verdict.resting) == {"Ixx", "If", "a"}
    ratios = {c.name: c for c in found.verdict.combinations}
    assert set(ratios) == {"a/Ixx", "a/If"}
    # The reference: with a known and without a prior, Ixx and If are as certain as the ratios.
    for name in started(BENCH):
        ratio, one = ratios[f"a/{name}"], alone.estimates[name]
        assert ratio.value == pytest.approx(BENCH["a"] / one.value, rel=1e-4)
        assert ratio.sd / ratio.value == pytest.approx(one.sd / one.value, rel=0.05)
        assert ratio.lower95 < BENCH["a"] / BENCH[name] < ratio.upper95
        # Far better known than either factor, which depends on the prior.
        assert ratio.sd / ratio.value < 0.1 * found.estimates[name].sd / found.estimates[name].value


def test_they_widen_with_autocorrelated_residuals(bench_run, resting):
    flight = bench_run
    white = np.random.default_rng(3).standard_normal(flight.n_samples)
    slow = np.convolve(white, 0.9 ** np.arange(60), mode="same") * 4e-3
    outputs = {"roll": flight.outputs["roll"] + slow}
    disturbed = type(flight)(dt=flight.dt, inputs=flight.inputs, outputs=outputs)
    found = fit(Problem(models.roll_on_stand, vehicle(BENCH), [disturbed], RESTING))
    assert found.coloured
    for c in found.verdict.combinations:
        name = c.name.removeprefix("a/")
        truth = BENCH["a"] / BENCH[name]
        assert c.lower95 < truth < c.upper95
        assert c.sd > 2.0 * resting.verdict.combinations[0].sd or name != "Ixx"


def test_added_inertia_determines_all_three():
    runs = [
        record(BENCH, seed=5, n=N, amplitude=2e-6, name="bare"),
        record(
            BENCH | {"Ixx_added": 0.012}, seed=6, n=N, amplitude=2e-6, name="loaded",
            known={"Ixx_added": 0.012},
        ),
    ]  # fmt: skip
    found = fit(Problem(models.roll_on_stand, vehicle(BENCH), runs, THREE))
    assert found.status == "converged"
    for name in THREE:
        e = found.estimates[name]
        assert abs(e.value - BENCH[name]) < 4.0 * e.sd
        assert e.sd < 0.02 * e.value


def test_gain_and_time_shift_are_found_with_their_signs():
    u = steps(np.random.default_rng(8), N, 0.02, 2e-6)
    y = response(BENCH, u, 0.02, True)
    late = np.concatenate([u[6:], np.full(6, u[-1])])  # the log shows the stick 0.12 s too early
    y = y + 1e-3 * np.random.default_rng(9).standard_normal(y.size)
    flight = Flight(dt=0.02, inputs={"x_roll": -late / 2e-6}, outputs={"roll": y})
    found = fit(
        Problem(
            models.roll_on_stand, vehicle(BENCH), [flight], {"If": IF},
            Nuisance(time_shift=True, input_gain=True),
        )
    )  # fmt: skip
    assert found.status == "converged"
    assert found.nuisance["time_shift"].value == pytest.approx(0.12, abs=2e-3)
    assert found.nuisance["gain x_roll"].value == pytest.approx(-2e-6, rel=0.02)


def test_many_starts_find_one_optimum_and_are_tabled(bench_run):
    free = {"Ixx": IXX, "If": Free(5e-4, 1e-5, 1e-2)}
    found = fit(
        Problem(models.roll_on_stand, vehicle(BENCH), [bench_run], free),
        starts=8, seed=3,
    )  # fmt: skip
    assert len(found.starts) == 8
    best = [row for row in found.starts if row.optimum == 1]
    assert len(best) >= 4
    assert all(row.end["Ixx"] == pytest.approx(0.024, rel=0.01) for row in best)
    assert [r.cost for r in best] == sorted(r.cost for r in best)


def test_coloured_residuals_are_called_so(bench_run, alone):
    rng = np.random.default_rng(4)
    drift = np.cumsum(rng.standard_normal(bench_run.n_samples)) * 1e-3
    disturbed = dataclasses.replace(
        bench_run, outputs={"roll": bench_run.outputs["roll"] + drift - drift.mean()}
    )
    found = fit(Problem(models.roll_on_stand, vehicle(BENCH), [disturbed], started(BENCH)))
    assert not found.white
    assert alone.white


def test_held_out_flight_is_predicted_not_fitted(bench_run, alone):
    other = record(BENCH, seed=12, n=N, hold_out=True, name="later")
    found = fit(Problem(models.roll_on_stand, vehicle(BENCH), [bench_run, other], started(BENCH)))
    assert found.estimates["Ixx"].value == alone.estimates["Ixx"].value
    assert found.validation["roll"].vaf > 0.999
    assert found.n_samples == bench_run.n_samples


def test_pitch_needs_its_inertia(bench_run):
    flight = Flight(
        dt=0.02, inputs={"x_pitch": bench_run.inputs["x_roll"]},
        outputs={"pitch": bench_run.outputs["roll"]},
    )  # fmt: skip
    with pytest.raises(ValueError, match="Iyy"):
        Problem(models.pitch, vehicle(BENCH), [flight], {"If": IF})
