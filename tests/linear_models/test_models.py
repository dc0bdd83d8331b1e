"""Shipped linear models against the R-50's report and SciPy's exponential."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import heli_jax
from heli_jax import naming
from heli_jax.analysis.linear import linearize, modes
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Free, Nuisance, Problem
from heli_jax.identification.unknowns.transforms import kind
from heli_jax.linear_models.read import linear_model
from heli_jax.simulation.simulate import simulate

STATES = {
    "roll": "phi p b d",
    "roll-flybarless": "phi p b",
    "pitch": "theta q a c",
    "pitch-flybarless": "theta q a",
    "attitude": "p q r a b c d",
    "attitude-flybarless": "p q r a b",
    "yaw": "r r_fb",
    "heave": "w",
    "heave-inflow": "w nu",
    "hybrid": "u v p q phi theta a b w r r_fb c d",
    "hybrid-flybarless": "u v p q phi theta a b w r r_fb",
    "r50-hover": "u v p q phi theta a b w r r_fb c d",
    "longitudinal": "u w q theta",
    "short-period": "alpha q",
    "phugoid": "u theta",
    "lateral-directional": "beta p r phi",
    "rate-first-order": "p q r",
    "rate-second-order": "p dp act",
    "quad-roll": "v p phi motor",
}


@pytest.mark.parametrize("name", STATES)
def test_a_shipped_model_has_its_states_and_every_constant_a_source(name):
    found = linear_model(name)
    assert found.model.name == name
    assert naming.names(found.model.State) == tuple(STATES[name].split())
    assert all(naming.unit(found.model.State, n) for n in naming.names(found.model.State))
    assert all(c.source for c in found.vehicle().constants.values())
    assert {n for n in found.content.parameters if n.startswith("tau")} <= set(found.model.positive)


# From the report, with its digits; pairs once.
R50 = (
    0.3061 + 0.0937j, -0.4007 + 0.0860j, -0.6079, -1.6996 + 8.1918j, -2.6623 + 11.5781j,
    -6.1966 + 8.1990j, -20.1675 + 4.6965j,
)  # fmt: skip


@pytest.mark.parametrize("name", ["r50-hover", "hybrid"])
def test_the_r50_has_its_published_eigenvalues(name):
    """Test equal eigenvalues in feet and in metres."""
    found = linear_model(name)
    values = modes(found.model, found.vehicle().params)
    np.testing.assert_allclose(
        np.sort_complex(values[values.imag >= 0]), np.sort_complex(R50), atol=5.1e-5
    )


def modes_of(name):
    """Return the eigenvalues with an imaginary part of at least zero, slowest first."""
    found = linear_model(name)
    values = modes(found.model, found.vehicle().params)
    return values[values.imag >= 0]


def test_the_navion_has_its_published_modes():
    """Test against NASA CR-177943, table 4.1, and rounded lateral modes after Nelson."""
    phugoid, short = modes_of("longitudinal")
    np.testing.assert_allclose([phugoid.real, phugoid.imag], [-0.017, 0.213], atol=5e-4)
    np.testing.assert_allclose([short.real, short.imag], [-2.51, 2.59], atol=5e-3)
    spiral, dutch_roll, roll = modes_of("lateral-directional")
    assert spiral == pytest.approx(-0.009, abs=5e-4)
    assert roll == pytest.approx(-8.4, abs=0.05)
    assert abs(dutch_roll) == pytest.approx(2.4, abs=0.05)
    assert -dutch_roll.real / abs(dutch_roll) == pytest.approx(0.20, abs=5e-3)


def test_approximate_modes_of_an_aeroplane():
    """Test against the published short period, and Lanchester's phugoid sqrt(2) g/U0."""
    assert modes_of("short-period") == pytest.approx([-2.51 + 2.59j], abs=0.007)
    assert abs(modes_of("phugoid")[0]) == pytest.approx(np.sqrt(2) * 32.2 / 176, rel=0.01)


def test_rate_responses_are_those_of_the_r50_without_its_flybar():
    found = {n: linear_model(n) for n in ("roll-flybarless", "rate-first-order")}
    A, B, *_ = linearize(*(f := found["roll-flybarless"])[:1], f.vehicle().params).matrices
    # p and b, and their roll rate if b follows at once.
    A, B = np.asarray(A)[1:, 1:], np.asarray(B)[1:]
    settled = A[0, 0] - A[0, 1] * A[1, 0] / A[1, 1], -A[0, 1] * B[1] / A[1, 1]
    first = found["rate-first-order"].vehicle().params
    np.testing.assert_allclose(-1 / first.tau_roll, settled[0], rtol=1e-3)
    np.testing.assert_allclose(first.K_roll / first.tau_roll, settled[1], rtol=1e-3)
    np.testing.assert_allclose(
        modes_of("rate-second-order")[0], modes_of("roll-flybarless")[1], rtol=1e-3
    )


def test_the_quadrotor_is_that_of_rotors():
    """Test derivatives by differences of the rotors' forces, as in gazebo_motor_model.cpp."""
    mass, inertia, height, arms = (
        1.5 + 4 * 0.005,
        0.0347563,
        0.023,
        np.array([-0.22, 0.2, 0.22, -0.2]),
    )
    thrust, drag = 8.54858e-6, 8.06428e-5
    hover = mass * 9.81 / 4

    def rates(v, p, lat):
        # y to the right, z down: arms are positive on the left, rotors are above the body.
        lift = hover * (1 + lat * np.sign(arms))
        side = -np.sqrt(hover / thrust) * drag * (v + height * p)
        return np.array([4 * side / mass, (np.sum(arms * lift) + height * 4 * side) / inertia])

    own = {n: c.value for n, c in linear_model("quad-roll").vehicle().constants.items()}
    at_rest = rates(0, 0, 0)
    by_v, by_p, by_lat = (rates(*step) - at_rest for step in np.eye(3))
    assert by_v == pytest.approx([own["Yv"], own["Lv"]], rel=1e-4)
    assert [by_p[1], by_lat[1]] == pytest.approx([own["Lp"], own["Llat"]], rel=1e-4)


@pytest.mark.parametrize(
    ("name", "free"),
    [
        ("longitudinal", ("Zw", "Mw", "Mq", "Mde")),
        ("short-period", ("Ma", "Mq", "Mde")),
        ("phugoid", ("Xu", "Zu", "Xthr")),
        ("lateral-directional", ("Lp", "Lda", "Nbeta", "Nr", "Ndr")),
        ("rate-first-order", ("K_roll", "tau_roll", "delay_roll", "K_yaw", "tau_yaw")),
        ("rate-second-order", ("K", "omega", "zeta")),
        ("quad-roll", ("Lv", "Llat", "tau_mot")),
    ],
)
def test_a_fit_of_its_own_record_finds_a_model(name, free):
    found, rng = linear_model(name), np.random.default_rng(3)
    (params, constants, _), dt, n = found.vehicle(), 0.02, 400
    truth = {p: constants[p].value for p in free}
    names = naming.names(found.model.Inputs)
    inputs = {i: np.repeat(0.01 * rng.uniform(-1.0, 1.0, n // 20), 20) for i in names}
    outputs = simulate(found.model, params, found.model.Inputs(**inputs), dt=dt).outputs
    measured = {
        o: np.asarray(y) + 0.01 * np.std(y) * rng.standard_normal(n)
        for o, y in naming.asdict(outputs).items()
    }
    problem = Problem(
        found.model,
        params,
        [Flight(dt=dt, inputs=inputs, outputs=measured)],
        {p: Free(1.2 * value) for p, value in truth.items()},
        Nuisance(initial_state=False, bias=False, input_offset=False),
    )
    fitted = heli_jax.fit(problem)
    assert fitted.status == "converged"
    for p, value in truth.items():
        estimate = fitted.estimates[p]
        assert estimate.sd < 0.1 * abs(value)
        assert abs(estimate.value - value) < 4.0 * estimate.sd


def test_inflow_that_has_settled_leaves_the_heave_of_the_r50():
    found, heave = linear_model("heave-inflow"), linear_model("heave")
    A, B, *_ = (np.asarray(M) for M in linearize(found.model, found.vehicle().params).matrices)
    settled = A[0, 0] - A[0, 1] * A[1, 0] / A[1, 1], B[0, 0] - A[0, 1] * B[1, 0] / A[1, 1]
    still = linearize(heave.model, heave.vehicle().params).matrices
    np.testing.assert_allclose(settled, (still.A[0, 0], still.B[0, 0]), rtol=1e-3)


def r50_by_hand():
    """Return A and B of the R-50 as published, in feet, entered by hand."""
    names = STATES["r50-hover"].split()
    A, B = np.zeros((13, 13)), np.zeros((13, 4))
    tau_f, tau_s = 0.04631, 0.3415
    rows = {
        "u": {"u": -0.05046, "theta": -32.2, "a": -32.2},
        "v": {"v": -0.1539, "phi": 32.2, "b": 32.2},
        "p": {"u": -0.1437, "v": 0.1432, "b": 166.1},
        "q": {"u": -0.0561, "v": -0.0585, "a": 82.57},
        "phi": {"p": 1.0},
        "theta": {"q": 1.0},
        "a": {"q": -1.0, "a": -1 / tau_f, "b": -0.1892 / tau_f, "c": 0.6439 / tau_f},
        "b": {"p": -1.0, "a": 0.3681 / tau_f, "b": -1 / tau_f, "d": 0.7103 / tau_f},
        "w": {"a": -0.1474, "b": -9.748, "w": -0.6141, "r": 0.9303},
        "r": {"v": 0.03013, "p": -3.525, "w": 0.08568, "r": -4.129, "r_fb": -33.07},
        "r_fb": {"r": 2.163, "r_fb": -8.258},
        "c": {"q": -1.0, "c": -1 / tau_s},
        "d": {"p": -1.0, "d": -1 / tau_s},
    }
    for i, row in enumerate(names):
        for column, value in rows[row].items():
            A[i, names.index(column)] = value
    # lat, lon, ped, col
    B[names.index("a"), :2] = 0.0313 / tau_f, -0.1004 / tau_f
    B[names.index("b"), :2] = 0.1398 / tau_f, 0.0138 / tau_f
    B[names.index("w"), 3] = -45.84
    B[names.index("r"), 2:] = 33.07, -3.329
    B[names.index("c"), 1] = -0.2587 / tau_s
    B[names.index("d"), 0] = 0.2731 / tau_s
    return A, B


def driven(A, B, U, dt):
    """Return states (N, n) for held inputs (N, m), by SciPy's exponential of [[A, B], [0, 0]]."""
    n, m = B.shape
    E = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * dt)
    X = np.zeros((len(U), n))
    for k in range(len(U) - 1):
        X[k + 1] = E[:n, :n] @ X[k] + E[:n, n:] @ U[k]
    return X


def test_the_r50_moves_as_scipys_exponential_says():
    """Test ten seconds, in which the slow mode grows twentyfold; without the pedal's delay."""
    rng = np.random.default_rng(50)
    dt, U = 0.02, np.repeat(0.1 * rng.uniform(-1.0, 1.0, (20, 4)), 25, axis=0)
    found = linear_model("r50-hover")
    model = dataclasses.replace(found.model, delays=())
    inputs = model.Inputs(**dict(zip(("lat", "lon", "ped", "col"), jnp.asarray(U.T), strict=True)))
    run = simulate(model, found.vehicle().params, inputs, dt=dt)
    expected = driven(*r50_by_hand(), U, dt)
    for i, name in enumerate(STATES["r50-hover"].split()):
        metres = expected[:, i] * (0.3048 if name in "uvw" else 1.0)
        size = np.max(np.abs(metres))
        assert size > 1e-3
        np.testing.assert_allclose(getattr(run.states, name), metres, rtol=0, atol=1e-10 * size)


def roll_by_hand(Lb, tau_f, Bd, Blat, tau_s=0.3415, Dlat=0.2731):
    A = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, Lb, 0.0],
            [0.0, -1.0, -1 / tau_f, Bd / tau_f],
            [0.0, -1.0, 0.0, -1 / tau_s],
        ]
    )
    return A, np.array([[0.0], [0.0], [Blat / tau_f], [Dlat / tau_s]])


@pytest.mark.slow
def test_a_fit_finds_the_derivatives_of_a_record_by_scipy():
    """Test starts off by a factor of two, and Blat from the wrong sign."""
    truth = {"Lb": 140.0, "tau_f": 0.06, "Bd": 0.6, "Blat": 0.12}
    rng = np.random.default_rng(17)
    dt, U = 0.02, np.repeat(0.2 * rng.uniform(-1.0, 1.0, (50, 1)), 20, axis=0)
    X, sd = driven(*roll_by_hand(**truth), U, dt), 0.01
    outputs = {
        "phi": X[:, 0] + 0.2 * sd * rng.standard_normal(len(X)),
        "p": X[:, 1] + sd * rng.standard_normal(len(X)),
    }
    found = linear_model("roll")
    problem = Problem(
        found.model,
        found.vehicle().params,
        [Flight(dt=dt, inputs={"lat": U[:, 0]}, outputs=outputs)],
        {"Lb": Free(70.0), "tau_f": Free(0.03), "Bd": Free(0.3), "Blat": Free(-0.05)},
        Nuisance(initial_state=False, bias=False, input_offset=False),
    )
    fitted = heli_jax.fit(problem)
    assert fitted.status == "converged"
    for name, value in truth.items():
        estimate = fitted.estimates[name]
        assert estimate.sd < 0.05 * abs(value)
        assert abs(estimate.value - value) < 4.0 * estimate.sd
    kinds = {n: kind(f) for n, f in problem.free.items()}
    assert kinds == {"Lb": "linear", "tau_f": "log", "Bd": "linear", "Blat": "linear"}


@pytest.mark.parametrize("free", [Free(-0.1), Free(0.1, lower=-1.0), Free(0.1, sign="any")])
def test_what_is_positive_starts_and_stays_above_zero(free):
    found = linear_model("roll")
    flight = Flight(dt=0.1, inputs={"lat": np.ones(9)}, outputs={"p": np.arange(9.0)})
    with pytest.raises(ValueError, match="tau_f"):
        Problem(found.model, found.vehicle().params, [flight], {"tau_f": free})
