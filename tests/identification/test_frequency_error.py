"""Frequency error: its basic identity, estimates, intervals and refusals."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from heli_jax import (
    Flight,
    Free,
    Nuisance,
    Problem,
    fit,
    linear_model,
    models,
    naming,
    simulate,
)
from heli_jax.dynamics.jacobians import point
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.frequency_lines import (
    cut_notes,
    errors_of_lines,
    linear_drive,
)
from heli_jax.identification.estimation.frequency_noise import smoothed
from heli_jax.identification.estimation.noise_covariance import first_noise
from heli_jax.identification.estimation.simulated_flights import Drive
from heli_jax.identification.select import MethodComparison, MethodResult
from heli_jax.identification.unknowns.layout import layout_of
from heli_jax.report.document import MethodsCompared, written
from tests.identification.bench import BENCH, denominators, record, steps, vehicle

DT = 0.02
FALLING = """
name: falling
states: {p: rad/s, phi: rad}
inputs: {lat: "1"}
outputs: {p: rad/s, phi: rad}
parameters:
  Lphi: {value: 2.0, unit: 1/s^2, source: none}
  Lp: {value: -1.0, unit: 1/s, source: none}
  Llat: {value: 10.0, unit: rad/s^2, source: none}
A: {p: {p: Lp, phi: Lphi}, phi: {p: 1}}
B: {p: {lat: Llat}}
C: {p: {p: 1}, phi: {phi: 1}}
"""


@pytest.fixture(scope="module")
def by(by_lines, fitted_by_lines):
    """Test the same record by two methods."""
    plain = fit(dataclasses.replace(by_lines, method="output-error"))
    return {"output-error": plain, "frequency-error": fitted_by_lines}


def test_estimates_are_those_of_output_error_in_white_noise(by):
    assert by["frequency-error"].status == "converged"
    for name, one in by["frequency-error"].estimates.items():
        other = by["output-error"].estimates[name]
        assert one.lower95 < BENCH[name] < one.upper95
        assert one.sd == pytest.approx(other.sd, rel=0.2)
        assert abs(one.value - other.value) < 1.5 * other.sd
    # The simulation in time has an initial state and bias, which no line determines.
    assert by["frequency-error"].metrics["roll"].vaf > 0.999
    assert by["frequency-error"].noise["flight 1/roll"] == pytest.approx(2e-3, rel=0.05)


def test_the_noise_to_check_by_is_what_the_inputs_leave():
    """Test gusts a tenth of the response to a chirp; a start's error is not noise."""
    roll, t = linear_model("roll-flybarless"), np.arange(0.0, 80.0, DT)
    lat = 0.1 * np.sin(2 * np.pi * (0.1 * t + 0.024 * t**2))
    params = roll.vehicle().params
    A = np.array([[0.0, params.Lb], [-1.0, -1 / params.tau_f]])
    B = np.array([[0.0], [params.Blat / params.tau_f]])
    p = scipy.signal.lsim((A, B, [[1.0, 0.0]], [[0.0]]), lat, t)[1]
    rng, slow = np.random.default_rng(0), scipy.signal.butter(1, 0.5, fs=1 / DT)
    gust = 0.3 * scipy.signal.lfilter(*slow, rng.standard_normal(t.size))
    noisy = p + gust + 3e-3 * rng.standard_normal(t.size)
    flight = Flight(dt=DT, inputs={"lat": lat}, outputs={"p": noisy}, hold={"lat": "linear"})
    free = {"Lb": Free(300.0), "tau_f": Free(0.02)}
    problem = Problem(roll.model, params, [flight], free, method="frequency-error")
    layout = layout_of(problem, [flight])
    data, begun = data_of(problem, [flight], layout), first_noise(problem, [flight])
    noise = layout.objective.noise_of_check(layout, data, begun)
    hz = np.arange(1, noise.whitening[0].shape[0] + 1) / (t.size * DT)
    true = np.abs(0.3 * scipy.signal.freqz(*slow, hz, fs=1 / DT)[1]) ** 2 + 3e-3**2
    found = 1.0 / np.abs(noise.whitening[0][:, 0, 0]) ** 2
    for low, high in ((0.1, 0.5), (0.5, 2.0), (2.0, 4.0), (5.0, 20.0)):
        ratio = (found / true)[(hz > low) & (hz < high)]
        assert 0.75 < np.mean(ratio) < 1.3, (low, ratio)
    # A fit begins as if everything were noise.
    swept = (hz > 0.5) & (hz < 2.0)
    assert np.mean(1.0 / np.abs(begun.whitening[0][swept, 0, 0]) ** 2 / true[swept]) > 5.0


def test_the_noise_spectrum_of_two_outputs_is_found():
    """Test a matrix over the outputs: correlated noise, white in one and slow in the other."""
    rng = np.random.default_rng(1)
    n = 8001
    common = rng.standard_normal(n)
    noise = np.stack([common, 0.5 * common + np.convolve(rng.standard_normal(n), [1, 0.9], "same")])
    lines = np.fft.rfft(noise, axis=1)[:, 1:].T / np.sqrt(n)
    [S] = smoothed([lines])
    omega = np.pi * np.arange(1, len(S) + 1) / (n / 2)
    middle = slice(800, -800)
    np.testing.assert_allclose(S[middle, 0, 0].real, 1.0, rtol=0.2)
    np.testing.assert_allclose(S[middle, 0, 1].real, 0.5, atol=0.2)
    slow = 0.25 + np.abs(1 + 0.9 * np.exp(-1j * omega)) ** 2
    np.testing.assert_allclose(S[middle, 1, 1].real, slow[middle], rtol=0.25)


def test_a_flight_is_cut_at_its_missing_samples():
    """Test SciPy's noiseless record: the model's error is rounding in each part."""
    whole = record(BENCH, seed=3, n=1500, noise=0.0)
    roll = whole.outputs["roll"].copy()
    for hole in (slice(700, 701), slice(1200, 1260), slice(1290, 1500)):
        roll[hole] = np.nan
    exact = dataclasses.replace(whole, outputs={"roll": roll})
    still = Nuisance(initial_state=False, bias=False)
    problem = Problem(
        models.roll_on_stand, vehicle(BENCH), [exact], {"Ixx": Free(BENCH["Ixx"])}, still,
        method="frequency-error",
    )  # fmt: skip
    layout = layout_of(problem, problem.training)
    assert layout.flight_facts[0].parts == ((0, 700), (701, 1200))
    data, noise = data_of(problem, problem.training, layout), first_noise(problem, [exact])
    at_truth = start_vector(layout, data, problem)
    lines = errors_of_lines(layout, data, noise, at_truth).errors
    assert [len(one) for one in lines] == [349, 249]
    np.testing.assert_allclose(np.concatenate(lines), 0.0, atol=1e-10)
    [note] = cut_notes(layout, data, ["flight 1"])
    assert (note.code, note.subjects) == ("frequency.flight-cut", ("roll",))


def test_methods_are_laid_side_by_side(by):
    main, other = by["output-error"], by["frequency-error"]
    results = (
        MethodResult("output-error", main, "", 1.0),
        MethodResult("frequency-error", other, "", 0.5),
        MethodResult("filter-error", None, "there is no disturbance", 0.0),
    )
    compared = MethodComparison(results)
    a, b = main.estimates["If"], other.estimates["If"]
    apart = (b.value - a.value) / (a.sd**2 + b.sd**2) ** 0.5
    assert compared.difference(results[1], "If") == pytest.approx(apart, rel=1e-12)
    content = written(MethodsCompared, compared)["results"]
    assert content["frequency-error"]["difference_joint_sd"]["If"] == pytest.approx(apart)
    # A free delay beside them is compared too.
    late = [
        r._replace(fit=dataclasses.replace(r.fit, nuisance={**r.fit.nuisance, "time_shift": delay}))
        for r, delay in zip(
            results[:2], (a._replace(value=0.03, sd=3e-4), a._replace(value=0.031, sd=4e-4)),
            strict=True,
        )
    ]  # fmt: skip
    assert MethodComparison(tuple(late)).difference(late[1], "time_shift") == pytest.approx(2.0)


def hardening(p, s, u):
    """The stand's spring with a cubic part."""
    rates = models.roll_on_stand.vector_field(p, s, u)
    return naming.replace(rates, dphi=rates.dphi - p.kappa * CUBIC * s.phi**3)


CUBIC = 20.0
HARD = dataclasses.replace(
    models.roll_on_stand, name="hard spring", vector_field=hardening, linear=False
)


def deflected(kappa: float, moment: float) -> float:
    """Return the angle at which a spring kappa (phi + CUBIC phi^3) holds a moment."""
    roots = np.roots([kappa * CUBIC, 0.0, kappa, -moment])
    return float(roots[np.abs(roots.imag) < 1e-9].real[0])


def stuck_out(seed: int) -> Problem:
    """Return a record about the deflection at the stick's mean."""
    rng = np.random.default_rng(seed)
    stick = 0.8e-6 + steps(rng, 1500, DT, 0.1e-6)
    begin = HARD.State(phi=deflected(4.0, held(stick)), dphi=0.0, beta_roll=0.0, dbeta_roll=0.0)
    inputs = HARD.Inputs(x_roll=jnp.asarray(stick))
    run = simulate(HARD, vehicle(BENCH), inputs, dt=DT, initial_state=begin)
    roll = np.asarray(run.outputs.roll) + 1e-3 * rng.standard_normal(1500)
    flight = Flight(dt=DT, inputs={"x_roll": stick}, outputs={"roll": roll})
    # An offset of the stick would change the point and its stiffness, which no line separates.
    known = Nuisance(input_offset=False)
    free = {"Ixx": Free(0.03), "kappa": Free(5.0)}
    return Problem(HARD, vehicle(BENCH), [flight], free, known, method="frequency-error")


def held(stick: np.ndarray) -> float:
    """Return the moment over the inertia from the stick's mean at rest."""
    return denominators(BENCH, True)[0][2] / BENCH["Omega"] ** 2 * float(stick.mean())


def test_the_point_of_linearisation_moves_with_the_parameters():
    problem = stuck_out(3)
    layout, stick = layout_of(problem, problem.training), problem.flights[0].inputs["x_roll"]

    def angle(kappa):
        params = naming.replace(vehicle(BENCH), kappa=kappa)
        drive = Drive(params, HARD.Inputs(x_roll=jnp.asarray(stick)), DT, None)
        _, drive = linear_drive(layout, drive, None)
        return point(HARD, drive.params)[0].phi

    phi, slope = jax.jvp(eqx.filter_jit(angle), (jnp.asarray(4.0),), (jnp.asarray(1.0),))
    assert float(phi) == pytest.approx(deflected(4.0, held(stick)), rel=1e-6)
    by_hand = (deflected(4.001, held(stick)) - deflected(3.999, held(stick))) / 0.002
    assert float(slope) == pytest.approx(by_hand, rel=1e-5)


@pytest.mark.slow
def test_a_model_that_is_not_linear_is_linearised_where_it_flies():
    found = fit(stuck_out(3))
    assert found.status == "converged"
    for name, one in found.estimates.items():
        assert one.lower95 < BENCH[name] < one.upper95
    [left_out] = [f for f in found.findings if f.code == "dynamics.linearised"]
    assert left_out.severity == "note"
    assert left_out.shifts.keys() == found.estimates.keys()
    assert found.exit_code == 0


def test_errors_that_overflow_have_no_spectrum(tmp_path):
    """Test that the relaxation then ends with NaN and without a warning."""
    path = tmp_path / "falling.yaml"
    path.write_text(FALLING)
    model, rng = linear_model(path), np.random.default_rng(0)
    flight = Flight(
        dt=DT,
        inputs={"lat": rng.standard_normal(300)},
        outputs={n: rng.standard_normal(300) for n in ("p", "phi")},
    )
    free = {"Lp": Free(1e6), "Llat": Free(1e200)}
    problem = Problem(model.model, model.vehicle().params, [flight], free, method="frequency-error")
    layout = layout_of(problem, problem.training)
    data = data_of(problem, problem.training, layout)
    noise, z = first_noise(problem, problem.training), start_vector(layout, data, problem)
    same, relaxed = layout.objective.relax(layout, data, noise, z)
    assert same is z
    assert np.isnan(relaxed.log_determinant)
    assert relaxed.whitening is noise.whitening
