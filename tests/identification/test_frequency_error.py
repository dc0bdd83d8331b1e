"""Frequency error: the identity it rests on, estimates and intervals, and what it refuses."""

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
from heli_jax.dynamics.linearised import point
from heli_jax.finding import Finding
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.frequency_lines import (
    errors_of_lines,
    resolved,
    states,
)
from heli_jax.identification.estimation.frequency_machines import Matrices
from heli_jax.identification.estimation.frequency_records import Record, cut_notes
from heli_jax.identification.estimation.frequency_spectrum import smoothed
from heli_jax.identification.estimation.linearised_flights import linear_drive
from heli_jax.identification.estimation.noise_covariance import first_noise
from heli_jax.identification.estimation.simulated_flights import Drive
from heli_jax.identification.frequency_start import _value, frequency_error_start, started
from heli_jax.identification.method_comparison import MethodComparison, MethodResult, _why_none
from heli_jax.identification.unknowns.initial_guess import start_vector
from heli_jax.identification.unknowns.layout import layout_of
from heli_jax.report.document import MethodsCompared, written
from heli_jax.report.tables import first_guess, methods
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


def two_states(growth: float, hold: str, n: int = 400) -> tuple[np.ndarray, ...]:
    """u and x (n + 1 samples) of x' = A x + B u by SciPy's exponential, exact for that hold."""
    A, B = np.array([[growth, 1.0], [-9.0, -0.8]]), np.array([[0.5], [2.0]])
    M = np.zeros((4, 4))
    M[:2, :2], M[:2, 2:3], M[2, 3] = A, B, 1.0 / DT
    E = scipy.linalg.expm(M * DT)
    G, R = E[:2, 2], E[:2, 3]
    u = np.cumsum(np.random.default_rng(0).standard_normal(n + 1)) * 0.1
    x = np.zeros((n + 1, 2))
    x[0] = 0.3, -1.0
    for k in range(n):
        # A ramp takes from this sample what it gives to the next one.
        ramp = R * (u[k + 1] - u[k]) if hold == "linear" else 0.0
        x[k + 1] = E[:2, :2] @ x[k] + G * u[k] + ramp
    return E[:2, :2], G, R, u, x


@pytest.mark.parametrize("hold", ["zero-order", "linear"])
@pytest.mark.parametrize("growth", [-0.5, 1.3])
def test_the_identity_holds_for_stable_and_unstable_machines(growth, hold):
    Ad, G, R, u, x = two_states(growth, hold)
    n = len(u) - 1
    z = np.exp(2j * np.pi * np.arange(1, n // 2) / n)
    X, U = (np.fft.fft(v[:n], axis=0)[1 : n // 2] for v in (x, u))
    U_next = np.fft.fft(u[1:])[1 : n // 2]
    drive = np.outer(U, G) + (np.outer(U_next - U, R) if hold == "linear" else 0.0)
    drive = drive + z[:, None] * (x[0] - x[n])[None, :]
    left = np.linalg.solve(z[:, None, None] * np.eye(2) - Ad, drive[:, :, None])[:, :, 0]
    np.testing.assert_allclose(left, X, atol=1e-12 * np.max(np.abs(X)) * n)


FREE = {"Ixx": Free(0.035), "If": Free(1.2e-4), "kappa": Free(7.0)}


def lines_of_a_machine(A: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whitened responses at the lines of a record, and the states."""
    n = A.shape[0]
    record = Record(0, 0, 40)
    m = Matrices(A, jnp.ones((n, 1)), jnp.eye(n)[:2], jnp.zeros((2, 1)))
    white = jnp.broadcast_to(jnp.eye(2, dtype=complex), (record.lines, 2, 2))
    at = resolved(m, record, white, jnp.asarray(1.0))
    return at.H, states(at, 0, jnp.ones((1, record.lines, n), complex))


def test_lines_without_a_triangle_are_the_same(monkeypatch):
    """Schur's triangle is for the CPU alone: the program is lowered for others without one."""
    A = jnp.array([[0.9, 0.2, 0.0], [-0.3, 0.8, 0.1], [0.0, 0.4, 0.7]])
    jax.jit(lines_of_a_machine).trace(A).lower(lowering_platforms=("cuda",))
    found = lines_of_a_machine(A)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, cpu, default: default(*args))
    for one, other in zip(found, lines_of_a_machine(A), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-12)


@pytest.fixture(scope="module")
def by():
    """The same record by two methods."""
    flight = record(BENCH, seed=3, n=3000)
    return {
        method: fit(Problem(models.roll_on_stand, vehicle(BENCH), [flight], FREE, method=method))
        for method in ("output-error", "frequency-error")
    }


def test_estimates_are_those_of_output_error_in_white_noise(by):
    assert by["frequency-error"].status == "converged"
    for name, one in by["frequency-error"].estimates.items():
        other = by["output-error"].estimates[name]
        assert one.lower95 < BENCH[name] < one.upper95
        assert one.sd == pytest.approx(other.sd, rel=0.2)
        assert abs(one.value - other.value) < 1.5 * other.sd
    # The simulation in time has initial state and bias of its own, though no line knows them.
    assert by["frequency-error"].metrics["roll"].vaf > 0.999
    assert by["frequency-error"].noise["flight 1/roll"] == pytest.approx(2e-3, rel=0.05)


def test_the_noise_to_check_by_is_what_the_inputs_leave():
    """Gusts a tenth as large as the answer to a chirp; what is wrong with the start is no noise."""
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
    noise = layout.estimator.as_it_ends(layout, data, begun)
    hz = np.arange(1, noise.whitening[0].shape[0] + 1) / (t.size * DT)
    true = np.abs(0.3 * scipy.signal.freqz(*slow, hz, fs=1 / DT)[1]) ** 2 + 3e-3**2
    found = 1.0 / np.abs(noise.whitening[0][:, 0, 0]) ** 2
    for low, high in ((0.1, 0.5), (0.5, 2.0), (2.0, 4.0), (5.0, 20.0)):
        ratio = (found / true)[(hz > low) & (hz < high)]
        assert 0.75 < np.mean(ratio) < 1.3, (low, ratio)
    # As if all of it were noise a fit begins.
    swept = (hz > 0.5) & (hz < 2.0)
    assert np.mean(1.0 / np.abs(begun.whitening[0][swept, 0, 0]) ** 2 / true[swept]) > 5.0


@pytest.mark.slow
def test_an_unstable_machine_needs_no_windows(tmp_path):
    """Roll with a divergence of 1 1/s, flown for 30 s in which it grows by 1e13."""
    path = tmp_path / "falling.yaml"
    path.write_text(FALLING)
    model = linear_model(path)
    rng = np.random.default_rng(2)
    M = np.zeros((3, 3))
    M[:2, :2], M[:2, 2] = [[-1.0, 2.0], [1.0, 0.0]], [10.0, 0.0]
    E = scipy.linalg.expm(M * DT)
    n = 1500
    steps = np.repeat(rng.uniform(-0.1, 0.1, n // 20 + 1), 20)[:n]
    x, u, y = np.zeros(2), np.zeros(n), np.zeros((n, 2))
    for k in range(n):
        y[k] = x + rng.standard_normal(2) * [0.02, 0.005]
        # A pilot who sees no noise, so that nothing of it comes back through the stick.
        u[k] = steps[k] - 0.3 * x[0] - 0.9 * x[1]
        x = E[:2, :2] @ x + E[:2, 2] * u[k]
    flight = Flight(dt=DT, inputs={"lat": u}, outputs={"p": y[:, 0], "phi": y[:, 1]})
    truth = {"Lphi": 2.0, "Lp": -1.0, "Llat": 10.0}
    free = {n: Free(1.4 * v) for n, v in truth.items()}
    found = fit(
        Problem(
            model.model, model.vehicle().params, [flight], free, Nuisance(bias=False),
            method="frequency-error",
        )
    )  # fmt: skip
    assert found.verdict.identifiable
    for name, one in found.estimates.items():
        assert one.lower95 < truth[name] < one.upper95
        assert one.sd < 0.1 * abs(truth[name])


def test_the_noise_spectrum_of_two_outputs_is_found():
    """A matrix over the outputs: correlated noise, white in one and slow in the other."""
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


def with_holes(flight: Flight, *holes: slice, **more) -> Flight:
    roll = flight.outputs["roll"].copy()
    for hole in holes:
        roll[hole] = np.nan
    return Flight(dt=flight.dt, inputs=flight.inputs, outputs={"roll": roll}, **more)


def problem_of(*flights: Flight, nuisance: Nuisance = Nuisance(), **free: Free) -> Problem:
    frees = free or {"Ixx": Free(0.035), "kappa": Free(7.0)}
    return Problem(
        models.roll_on_stand, vehicle(BENCH), flights, frees, nuisance, method="frequency-error"
    )


HOLES = slice(700, 701), slice(1200, 1260), slice(1290, 1500)


def test_a_flight_is_cut_at_its_missing_samples():
    """Of SciPy's noiseless record the model's error is nothing but rounding in each part."""
    exact = with_holes(record(BENCH, seed=3, n=1500, noise=0.0), *HOLES)
    still = Nuisance(initial_state=False, bias=False)
    problem = problem_of(exact, nuisance=still, Ixx=Free(BENCH["Ixx"]))
    layout = layout_of(problem, problem.training)
    assert layout.of_flights[0].parts == ((0, 700), (701, 1200))
    data, noise = data_of(problem, problem.training, layout), first_noise(problem, [exact])
    at_truth = start_vector(layout, data, problem)
    lines = errors_of_lines(layout, data, noise, at_truth).errors
    assert [len(one) for one in lines] == [349, 249]
    np.testing.assert_allclose(np.concatenate(lines), 0.0, atol=1e-10)
    [note] = cut_notes(layout, data, ["flight 1"])
    assert (note.code, note.subjects) == ("frequency.flight-cut", ("roll",))


@pytest.mark.slow
def test_estimates_of_a_flight_that_was_cut():
    noisy = with_holes(record(BENCH, seed=3, n=1500), *HOLES)
    found = fit(problem_of(noisy, with_holes(noisy, slice(3, 500, 2), hold_out=True)))
    assert found.status == "converged"
    assert "frequency.flight-cut" in {f.code for f in found.findings}
    for name, one in found.estimates.items():
        assert one.lower95 < BENCH[name] < one.upper95
    # A flight held out is predicted in time, with an initial state and a bias of its own.
    assert found.validation["roll"].vaf > 0.999


def test_an_output_that_is_sparse_throughout_is_refused():
    whole = record(BENCH, seed=3, n=1500)
    sparse = with_holes(whole, *(slice(k, None, 5) for k in range(1, 5)), name="first")
    with pytest.raises(ValueError, match=r"first: output roll lacks 80 % .* lower flights\[\]"):
        problem_of(sparse)


@pytest.mark.slow
def test_a_fit_in_time_begins_at_the_estimate_in_frequency():
    """A stand that swings 60 times in the record, every start four times too small: by itself the
    simulation loses count."""
    swinging = {**BENCH, "zeta": 0.02, "kappa": 40.0}
    free = {n: Free(0.25 * swinging[n]) for n in FREE}
    flight = record(swinging, seed=3, n=3000)
    problem = Problem(models.roll_on_stand, vehicle(swinging), [flight], free)
    guess = frequency_error_start(problem)
    begun = started(problem, guess)
    for name, value in guess.values.items():
        assert value.origin == "frequency error"
        assert value.value == pytest.approx(swinging[name], rel=0.01)
        assert begun.free[name].start == value.value
    found = fit(begun)
    assert found.status == "converged"
    assert found.starts[0].steps < 5
    assert "Start by frequency error of Ixx, If, kappa" in guess.sentences[0]
    assert [row[3] for row in first_guess(guess).rows] == ["frequency error"] * 3
    # What is not determined begins as it was stated.
    assert _value(found.estimates["Ixx"]._replace(sd=None), "not-identifiable", 0.5).value == 0.5


def test_methods_are_laid_side_by_side(by):
    main, other = by["output-error"], by["frequency-error"]
    stopped = Finding("search.stopped", "doubt", "The optimiser stopped.")
    stuck = dataclasses.replace(main, status="not-converged", findings=(stopped,))
    results = (
        MethodResult("output-error", main, "", 1.0),
        MethodResult("frequency-error", other, "", 0.5),
        MethodResult("filter-error", None, "there is no disturbance", 0.0),
    )
    compared = MethodComparison(results)
    a, b = main.estimates["If"], other.estimates["If"]
    apart = (b.value - a.value) / (a.sd**2 + b.sd**2) ** 0.5
    assert compared.difference(results[1], "If") == pytest.approx(apart, rel=1e-12)
    assert compared.sentences == (
        "filter error has no numbers: there is no disturbance",
        "frequency error and output error agree within 2 joint standard deviations in Ixx, If, "
        "kappa.",
    )
    rows = methods(compared).rows
    assert [row[0] for row in rows] == ["Ixx", "If", "kappa", "verdict", "time"]
    assert rows[3] == ("verdict", "converged, adequate", "converged, adequate", "", "refused", "")
    assert rows[0][4:] == ("–", "–")
    # No plain word beside a fit that has a doubt of its own.
    shifts = {"If": 2.0 * b.sd}
    doubt = Finding("dynamics.depends-on-amplitude", "doubt", "", shifts=shifts)
    doubted = dataclasses.replace(other, findings=(doubt,))
    assert MethodResult("frequency-error", doubted, "", 0.5).word == "If not trusted"
    content = written(MethodsCompared, compared)["results"]
    assert content["frequency-error"]["difference_joint_sd"]["If"] == pytest.approx(apart)
    assert content["filter-error"]["reason"] == "there is no disturbance"
    moved = {**other.estimates, "If": b._replace(value=a.value + 5.0 * (a.sd**2 + b.sd**2) ** 0.5)}
    away = results[1]._replace(fit=dataclasses.replace(other, estimates=moved))
    assert "differ in If by 5.0 joint" in MethodComparison((results[0], away)).sentences[0]
    assert _why_none(stuck) == "The optimiser stopped."
    # A delay that was free beside them is compared too.
    late = [
        r._replace(fit=dataclasses.replace(r.fit, nuisance={**r.fit.nuisance, "time_shift": delay}))
        for r, delay in zip(
            results[:2], (a._replace(value=0.03, sd=3e-4), a._replace(value=0.031, sd=4e-4)),
            strict=True,
        )
    ]  # fmt: skip
    compared = MethodComparison(tuple(late))
    assert compared.difference(late[1], "time_shift") == pytest.approx(2.0)
    assert [row[0] for row in methods(compared).rows][3:] == ["time_shift", "verdict", "time"]
    assert (
        "time_shift"
        in written(MethodsCompared, compared)["results"]["frequency-error"]["parameters"]
    )


def hardening(p, s, u):
    """The stand's spring with a cubic part."""
    rates = models.roll_on_stand.vector_field(p, s, u)
    return naming.replace(rates, dphi=rates.dphi - p.kappa * CUBIC * s.phi**3)


CUBIC = 20.0
HARD = dataclasses.replace(
    models.roll_on_stand, name="hard spring", vector_field=hardening, linear=False
)


def deflected(kappa: float, moment: float) -> float:
    """The angle at which a spring kappa (phi + CUBIC phi^3) holds a moment."""
    roots = np.roots([kappa * CUBIC, 0.0, kappa, -moment])
    return float(roots[np.abs(roots.imag) < 1e-9].real[0])


def stuck_out(seed: int) -> Problem:
    """A record about the deflection that the mean of the stick makes."""
    rng = np.random.default_rng(seed)
    stick = 0.8e-6 + steps(rng, 1500, DT, 0.1e-6)
    begin = HARD.State(phi=deflected(4.0, held(stick)), dphi=0.0, beta_roll=0.0, dbeta_roll=0.0)
    inputs = HARD.Inputs(x_roll=jnp.asarray(stick))
    run = simulate(HARD, vehicle(BENCH), inputs, dt=DT, initial_state=begin)
    roll = np.asarray(run.outputs.roll) + 1e-3 * rng.standard_normal(1500)
    flight = Flight(dt=DT, inputs={"x_roll": stick}, outputs={"roll": roll})
    # An offset of the stick would move the point, and with it the stiffness: no line tells the two.
    known = Nuisance(input_offset=False)
    free = {"Ixx": Free(0.03), "kappa": Free(5.0)}
    return Problem(HARD, vehicle(BENCH), [flight], free, known, method="frequency-error")


def held(stick: np.ndarray) -> float:
    """The moment over the inertia that the mean of the stick makes at rest."""
    return denominators(BENCH, True)[0][2] / BENCH["Omega"] ** 2 * float(stick.mean())


def test_the_point_of_linearisation_moves_with_the_parameters():
    problem = stuck_out(3)
    layout, stick = layout_of(problem, problem.training), problem.flights[0].inputs["x_roll"]

    def angle(kappa):
        params = naming.replace(vehicle(BENCH), kappa=kappa)
        drive = Drive(params, HARD.Inputs(x_roll=jnp.asarray(stick)), DT, None)
        _, drive, rest = linear_drive(layout, drive, None)
        return point(HARD, drive.params)[0].phi, rest

    (phi, rest), slope = jax.jvp(eqx.filter_jit(angle), (jnp.asarray(4.0),), (jnp.asarray(1.0),))
    assert rest
    assert float(phi) == pytest.approx(deflected(4.0, held(stick)), rel=1e-6)
    by_hand = (deflected(4.001, held(stick)) - deflected(3.999, held(stick))) / 0.002
    assert float(slope[0]) == pytest.approx(by_hand, rel=1e-5)


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


@pytest.mark.slow
def test_a_shift_of_the_inputs_is_a_phase():
    flight = record(BENCH, seed=6, n=3000)
    late = np.concatenate([np.full(3, flight.outputs["roll"][0]), flight.outputs["roll"][:-3]])
    found = fit(
        Problem(
            models.roll_on_stand,
            vehicle(BENCH),
            [Flight(dt=flight.dt, inputs=flight.inputs, outputs={"roll": late})],
            {"Ixx": Free(0.03), "kappa": Free(5.0)},
            Nuisance(time_shift=True),
            method="frequency-error",
        )
    )
    shift = found.nuisance["time_shift"]
    assert shift.lower95 < 3 * flight.dt < shift.upper95
    assert jnp.isfinite(shift.sd)


def test_errors_that_overflow_have_no_spectrum(tmp_path):
    """Where they do the relaxation ends, with a level that is no number, and warns of nothing."""
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
    same, relaxed = layout.estimator.relax(layout, data, None, noise, z)
    assert same is z
    assert np.isnan(relaxed.log_variance_ratio)
    assert relaxed.whitening is noise.whitening
