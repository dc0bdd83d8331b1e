"""Filter error on disturbed records, and on records without a disturbance."""

import dataclasses
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit, models, simulate
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.filter_error import disturbed_records
from heli_jax.identification.estimation.noise_covariance import first_noise
from heli_jax.identification.fit import context_of
from heli_jax.identification.unknowns.layout import Solution, layout_of, unpack
from heli_jax.identification.validation.metrics import whiteness
from heli_jax.naming import asdict, replace
from heli_jax.simulation.inputs import random_steps

DT, N = 0.02, 1000
TRUTH = {"kappa": 4.0, "zeta": 0.2, "sigma_w": 1.04, "tau_w": 1.0}
FREE = {"Ixx": Free(0.03), "If": Free(2.5e-4), "kappa": Free(3.0)}


def made(bench30, seed, *, sigma_w=1.04, poles=1, amplitude=3e-6):
    model = with_disturbance(models.roll_on_stand, "roll", poles)
    values = {**TRUTH, "sigma_w": sigma_w}
    params = model.Params(**{**asdict(bench30), **{n: jnp.asarray(v) for n, v in values.items()}})
    rng = np.random.default_rng(seed)
    u = amplitude * random_steps(N, DT, rng, (0.2, 1.5))
    run = simulate(
        model, params, model.Inputs(x_roll=jnp.asarray(u)), dt=DT, key=jax.random.key(seed)
    )
    y = np.asarray(run.outputs.roll) + 2e-3 * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    start = replace(params, sigma_w=jnp.asarray(0.0), tau_w=jnp.asarray(0.3))
    return model, params, start, flight


@pytest.fixture(scope="module")
def disturbed(bench30):
    """Return a record, its problem and its fit, the reference for other fits."""
    model, params, start, flight = made(bench30, 1)
    problem = Problem(model, start, [flight], FREE, method="filter-error")
    return params, problem, fit(problem)


def test_a_record_of_gusts_alone_follows_no_input(bench30, disturbed):
    # What follows of it for the machine stands and falls with the noise.
    _, problem, first = disturbed
    gusts = dataclasses.replace(problem, flights=[made(bench30, 1, amplitude=1e-10)[3]])
    assert context_of(gusts).unrelated
    assert not context_of(problem).unrelated
    assert first.verdict.identifiable


def errors(found, params):
    return {n: (e.value - float(getattr(params, n))) / e.sd for n, e in found.estimates.items()}


def test_a_disturbed_record_gives_parameters_and_noise_within_their_intervals(disturbed):
    params, _, found = disturbed
    assert found.status == "converged"
    assert found.steps <= 40
    assert all(abs(e) < 4 for e in errors(found, params).values())
    assert found.estimates["Ixx"].sd < 0.15 * float(params.Ixx)
    for name in ("sigma_w", "tau_w"):
        one = found.nuisance[name]
        assert abs(np.log(one.value / TRUTH[name])) < 4 * one.sd / one.value
    assert found.noise["flight 1/roll"] == pytest.approx(2e-3, rel=0.1)
    assert found.white


def test_white_noise_alone_ends_as_output_error(bench30):
    model, _, start, flight = made(bench30, 1, sigma_w=1e-9)
    filtered = fit(Problem(model, start, [flight], FREE, method="filter-error"))
    plain = fit(Problem(model, start, [flight], FREE))
    assert filtered.status == plain.status == "converged"
    for name, one in plain.estimates.items():
        assert filtered.estimates[name].sd == pytest.approx(one.sd, rel=0.05)
        assert filtered.estimates[name].value == pytest.approx(one.value, abs=0.1 * one.sd)
    assert filtered.nuisance["sigma_w"].at_bound
    assert "noise.no-disturbance" in {f.code for f in filtered.findings}


def test_missing_samples_cost_information_and_no_more(disturbed):
    params, problem, _ = disturbed
    [flight] = problem.flights
    roll = flight.outputs["roll"].copy()
    gone = np.random.default_rng(0).uniform(size=N) < 0.3
    gone[400:500] = True
    flight = dataclasses.replace(flight, outputs={"roll": np.where(gone, np.nan, roll)})
    found = fit(dataclasses.replace(problem, flights=[flight]))
    assert found.status == "converged"
    assert found.n_samples == np.count_nonzero(~gone)
    assert all(abs(e) < 4 for e in errors(found, params).values())
    assert np.isfinite(found.signals[0].simulated["roll"]).all()
    assert np.isfinite(found.metrics["roll"].vaf)


@pytest.mark.slow
def test_noise_that_cannot_be_is_told(disturbed):
    _, problem, _ = disturbed
    [flight] = problem.flights
    start = replace(problem.vehicle, sigma_w=jnp.asarray(1.0), tau_w=jnp.asarray(1.0))

    def run(sd, steps):
        flights = [dataclasses.replace(flight, sd={"roll": sd})]
        fixed = ("sigma_w", "tau_w", "sigma_y")
        fixed_ = dataclasses.replace(problem, vehicle=start, flights=flights, fixed_noise=fixed)
        return fit(fixed_, max_steps=steps)

    too_small = run(2e-4, 30)
    [size] = [f for f in too_small.findings if f.code == "noise.innovations-size"]
    assert size.value == pytest.approx(10.0, rel=0.2)
    assert too_small.untrusted == tuple(too_small.estimates)
    no_digits = run(1e-13, 5)
    assert no_digits.status == "not-converged"
    # Rounding has no information: there is no interval, and no note on the optimiser's end.
    assert all(e.sd is None and e.lower95 is None for e in no_digits.estimates.values())
    codes = {f.code for f in no_digits.findings}
    assert "search.stopped" not in codes
    assert "search.ill-conditioned" in codes
    assert all(np.isfinite(e.value) for e in no_digits.estimates.values())


def test_a_flight_held_out_is_predicted_and_not_fitted(bench30, disturbed):
    _, problem, alone = disturbed
    other = dataclasses.replace(made(bench30, 2)[3], hold_out=True, name="held")
    both = fit(dataclasses.replace(problem, flights=[*problem.flights, other]))
    assert both.n_samples == N
    for name, one in both.estimates.items():
        assert one.value == pytest.approx(alone.estimates[name].value, rel=1e-6)
    assert both.one_step_validation["roll"].rmse == pytest.approx(
        both.one_step["roll"].rmse, rel=0.1
    )
    assert both.one_step_validation["roll"].vaf > 0.99
    assert both.validation["roll"].vaf < both.one_step_validation["roll"].vaf
    held = both.signals[1]
    assert held.hold_out
    assert whiteness(held.error("roll")).white


@pytest.mark.slow
def test_swapped_columns_are_told(bench30):
    """Test exchanged stick and angle: an unstable model held by the filter fits best."""
    model, _, start, flight = made(bench30, 3)
    stick, angle = flight.inputs["x_roll"], flight.outputs["roll"]
    swapped = Flight(
        dt=DT, inputs={"x_roll": 1e-6 * angle}, outputs={"roll": np.deg2rad(1e6 * stick)}
    )
    found = fit(Problem(model, start, [swapped], FREE, method="filter-error"))
    assert found.metrics["roll"].vaf < 0
    assert found.exit_code == 4


@pytest.mark.slow
def test_records_of_the_bootstrap_begin_with_a_stationary_disturbance(bench30):
    """Test two poles: the first sample's states have sd sigma_w and the correlation 1/sqrt(2)."""
    model, _, start, flight = made(bench30, 0, poles=2)
    shown = dataclasses.replace(
        model, output=lambda p, s, u: model.Outputs(roll=s.w1_roll, roll_rate=s.w2_roll)
    )
    start = replace(start, sigma_w=jnp.asarray(1.04), tau_w=jnp.asarray(1.0))
    short = Flight(
        dt=DT,
        inputs={n: v[:10] for n, v in flight.inputs.items()},
        outputs=dict.fromkeys(("roll", "roll_rate"), flight.outputs["roll"][:10]),
    )
    nuisance = Nuisance(bias=False, initial_state=False)
    problem = Problem(shown, start, [short], FREE, nuisance, method="filter-error")
    layout, data = layout_of(problem, problem.training), data_of(problem, problem.training)
    z = start_vector(layout, data, problem)
    at = Solution(layout, data, first_noise(problem, problem.training), z)
    u = unpack(layout, data, z)
    made_ = disturbed_records(at, u, 0, jax.random.split(jax.random.key(0), 4000))
    first = np.stack([made_["roll"][:, 0], made_["roll_rate"][:, 0]])
    sigma = float(u.noise["sigma_w"])
    np.testing.assert_allclose(
        np.cov(first) / sigma**2, [[1.0, 0.5**0.5], [0.5**0.5, 1.0]], atol=0.07
    )


class Pendulum(NamedTuple):
    w2: Annotated[float, "1/s^2", "square of the frequency"]
    d: Annotated[float, "1/s", "damping"]
    k: Annotated[float, "rad/s^2", "effect of the input"]


class Swing(NamedTuple):
    phi: Annotated[float, "rad", "angle"]
    p: Annotated[float, "rad/s", "rate"]


class Torque(NamedTuple):
    u: Annotated[float, "1", "input"]


def swinging(q, s, u):
    return Swing(s.p, -q.w2 * jnp.sin(s.phi) - q.d * s.p + q.k * u.u)


def swung(truth, sigma, tau, rng, n=1500, substeps=10):
    """Return a record of a pendulum in gusts by RK4, phi and p with noise."""
    u, h = np.repeat(rng.uniform(-1.0, 1.0, n // 15), 15), DT / substeps
    s, w, states = np.zeros(2), sigma * rng.standard_normal(), np.zeros((n, 2))
    for k in range(n):
        states[k] = s
        for _ in range(substeps):

            def rate(s, push=truth["k"] * u[k] + w):
                return np.array([s[1], -truth["w2"] * np.sin(s[0]) - truth["d"] * s[1] + push])

            a = rate(s)
            b = rate(s + 0.5 * h * a)
            c = rate(s + 0.5 * h * b)
            s = s + h / 6.0 * (a + 2.0 * (b + c) + rate(s + h * c))
            kept = np.exp(-h / tau)
            w = kept * w + sigma * (1.0 - kept**2) ** 0.5 * rng.standard_normal()
    y = states + np.array([0.02, 0.05]) * rng.standard_normal((n, 2))
    return Flight(dt=DT, inputs={"u": u}, outputs={"phi": y[:, 0], "p": y[:, 1]})


@pytest.mark.slow
def test_a_pendulum_that_gusts_carry_over_the_top_is_adequate():
    truth = {"w2": 20.0, "d": 0.8, "k": 15.0}
    flight = swung(truth, 10.0, 0.5, np.random.default_rng(3))
    assert 2.0 * np.pi < np.ptp(flight.outputs["phi"]) < 4.0 * np.pi
    plain = Model("pendulum", swinging, lambda q, s, u: s, Pendulum, Swing, Torque, Swing)
    model = with_disturbance(plain, "p")
    start = model.Params(w2=23.0, d=1.0, k=14.0, sigma_w=5.0, tau_w=0.8)
    free = {n: Free(getattr(start, n)) for n in truth}
    found = fit(Problem(model, start, [flight], free, method="filter-error"))
    assert found.status == "converged"
    assert all(w.white for w in found.whiteness.values())
    for name, value in truth.items():
        one = found.estimates[name]
        assert abs(one.value - value) < 4.0 * one.sd
    # Over the whole record the simulated phi departs from the measured one; over 2 s it does not.
    assert found.metrics["phi"].vaf < 0.1
    assert found.adequacy.ahead == 2.0
    assert found.exit_code == 0
    for output in found.adequacy.judged:
        assert output.adequate
        assert output.vaf > 0.5
