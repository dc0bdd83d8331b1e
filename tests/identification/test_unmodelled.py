"""Missing parts of a model, found in its residuals; a right model has none.

Records are made by SciPy: its integrators, and the exact response of linear systems.
"""

from types import SimpleNamespace
from typing import Annotated, NamedTuple

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

from heli_jax import Flight, Free, Model, Problem, fit
from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.identification.diagnostics.residuals import responses_explained
from heli_jax.identification.validation.score_test import (
    BROAD,
    NARROW,
    Drive,
    lines_of,
    strongest,
)
from heli_jax.naming import Scalar
from tests.identification.lag import LAG, Inputs, Params, Rate, response

N, DT = 1500, 0.02


def steps(rng):
    """Return a stick held for 0.2 to 0.8 s, of any size up to 0.1."""
    u = np.zeros(N)
    k = 0
    while k < N:
        n = int(rng.uniform(10, 40))
        u[k : k + n] = rng.uniform(-0.1, 0.1)
        k += n
    return u


def right(u):
    return response(-4.0, 20.0, u, DT)


def with_payload(u):
    """Return p with a hanging payload at 6 rad/s, damping 0.03."""
    w, z, k = 6.0, 0.03, 12.0
    A = np.array([[-4.0, k, 0.0], [0.0, 0.0, 1.0], [4.0, -w * w - k, -2.0 * z * w]])
    system = (A, np.array([[20.0], [0.0], [-20.0]]), np.eye(3), np.zeros((3, 1)))
    return scipy.signal.dlsim((*scipy.signal.cont2discrete(system, DT)[:4], DT), u)[1][:, 0]


def saturated(u):
    """Return p for a moment that saturates at 1.2 rad/s^2, as sharply as tanh."""

    def rate(t, p):
        return -4.0 * p + 1.2 * np.tanh(20.0 * u[min(int(t / DT + 1e-9), N - 1)] / 1.2)

    found = scipy.integrate.solve_ivp(
        rate, (0.0, N * DT), [0.0], t_eval=np.arange(N) * DT, max_step=DT, rtol=1e-6
    )
    return found.y[0]


def through_play(u):
    """Return p of a first-order vehicle after a linkage with play of an eighth of the range."""
    at, v = 0.0, np.zeros(N)
    for k, x in enumerate(u):
        at = min(max(at, x - 0.0125), x + 0.0125)
        v[k] = at
    return right(v)


def to_one_side(u):
    """Return p for a stick with 10 % more effect to one side, visible in even powers."""
    return right(u + 0.05 * np.abs(u))


def with_dry_friction(u):
    """Return p with Coulomb friction, by steps of 1 ms."""
    p, out = 0.0, np.zeros(N)
    for k, x in enumerate(u):
        out[k] = p
        for _ in range(20):
            p += 0.001 * (-4.0 * p + 20.0 * x - 0.1 * np.tanh(p / 0.02))
    return out


def with_drag(u):
    """Return p with additional quadratic damping, by steps of 1 ms."""
    p, out = 0.0, np.zeros(N)
    for k, x in enumerate(u):
        out[k] = p
        for _ in range(20):
            p += 0.001 * (-4.0 * p - 3.0 * abs(p) * p + 20.0 * x)
    return out


def slowing_down(u):
    """Return p of a rotor that steadily loses a fifth of its moment."""
    return right(u * np.linspace(1.1, 0.9, N))


def fitted(made, method, *, seed=3, noise=0.1, coloured=0.0):
    rng = np.random.default_rng(seed)
    u = steps(rng)
    disturbed = scipy.signal.lfilter([1.0], [1.0, -0.95], rng.standard_normal(N)) * coloured
    p = made(u) + noise * rng.standard_normal(N) + disturbed
    flight = Flight(dt=DT, inputs={"d": u}, outputs={"p": p})
    free = {"Lp": Free(-3.0), "Ld": Free(15.0)}
    return fit(Problem(LAG, Params(-3.0, 15.0), [flight], free, method=method))


def misfit(found, code):
    """Return the only finding of this code.

    It removes an interval exactly if it moves the estimate by more than half of it, or by an
    unknown amount.
    """
    [one] = [f for f in found.findings if f.code == code]
    assert one.subjects[0] == "p"
    assert one.value < 0.01
    moved = {n: abs(by) > 1.96 * found.estimates[n].sd for n, by in one.shifts.items()}
    assert (one.severity == "doubt") is (any(moved.values()) or bool(one.distrusts))
    for name, far in moved.items():
        assert not far or name in found.untrusted
        assert (found.estimates[name].lower95 is None) is (name in found.untrusted)
    assert found.exit_code == (3 if found.untrusted else 0)
    return one


FOLLOWS = "dynamics.residual-follows-input"
AMPLITUDE = "dynamics.depends-on-amplitude"
CHANGES = "dynamics.changes-over-record"


@pytest.mark.parametrize(
    ("made", "method", "noise", "code", "untrusted"),
    [
        # Its residual is almost white, with a few per cent of the output's power.
        (with_payload, "output-error", 0.3, FOLLOWS, True),
        (with_payload, "frequency-error", 0.3, FOLLOWS, True),
        (saturated, "frequency-error", 0.02, AMPLITUDE, True),
        # Powers of stick and response do not describe play, so the result is open.
        (through_play, "output-error", 0.02, AMPLITUDE, None),
        (to_one_side, "output-error", 0.02, AMPLITUDE, None),
        (with_dry_friction, "output-error", 0.02, AMPLITUDE, None),
        (with_drag, "output-error", 0.02, AMPLITUDE, True),
        (slowing_down, "output-error", 0.02, CHANGES, True),
    ],
)
def test_what_is_left_out_takes_the_intervals_that_it_moves(made, method, noise, code, untrusted):
    found = fitted(made, method, noise=noise)
    assert found.status == "converged"
    misfit(found, code)
    assert untrusted is None or found.exit_code == 3


class Sprung(NamedTuple):
    Lp: Annotated[Scalar, "1/s", "damping"]
    Ld: Annotated[Scalar, "1/s^2", "effectiveness"]
    k: Annotated[Scalar, "1/s^2", "spring"]


class Swing(NamedTuple):
    p: Annotated[Scalar, "rad/s", "rate"]
    angle: Annotated[Scalar, "rad", "angle"]


def test_a_spring_that_is_not_linear_is_seen_where_only_the_rate_is_measured():
    rng = np.random.default_rng(3)
    u, p, angle, out = steps(rng), 0.0, 0.0, np.zeros(N)
    for i, x in enumerate(u):
        out[i] = p
        for _ in range(20):
            p += 0.001 * (-4.0 * p - 16.0 * angle - 2000.0 * angle**3 + 20.0 * x)
            angle += 0.001 * p
    model = Model(
        "sprung",
        lambda q, x, u: Swing(p=q.Lp * x.p - q.k * x.angle + q.Ld * u.d, angle=x.p),
        lambda q, x, u: Rate(p=x.p),
        Sprung, Swing, Inputs, Rate, linear=True,
    )  # fmt: skip
    noisy = out + 0.005 * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"d": u}, outputs={"p": noisy}, hold={"d": "zero-order"})
    free = {"Lp": Free(-3.0), "Ld": Free(15.0), "k": Free(10.0)}
    found = fit(Problem(model, Sprung(-3.0, 15.0, 10.0), [flight], free))
    assert misfit(found, AMPLITUDE).shifts["k"] < 0.0
    assert found.estimates["k"].value > 16.0
    assert "k" in found.untrusted


@pytest.mark.slow
def test_a_flight_with_a_stick_of_another_scale_is_named():
    rng, flights = np.random.default_rng(5), []
    for name, scale in (("one", 1.0), ("two", 1.1), ("three", 1.0)):
        u = steps(rng)
        p = right(u) + 0.02 * rng.standard_normal(N)
        flights.append(Flight(dt=DT, inputs={"d": scale * u}, outputs={"p": p}, name=name))
    free = {"Lp": Free(-3.0), "Ld": Free(15.0)}
    found = fit(Problem(LAG, Params(-3.0, 15.0), flights, free))
    one = misfit(found, "dynamics.flights-differ")
    assert one.subjects == ("p", "two", "the others")
    assert "Ld" in found.untrusted


@pytest.mark.parametrize(
    ("method", "coloured"),
    [("output-error", 0.0), ("frequency-error", 0.02), ("frequency-response", 0.02)],
)
def test_nothing_is_missed_of_a_right_model(method, coloured):
    found = fitted(right, method, coloured=coloured)
    assert found.exit_code == 0
    assert not [f for f in found.findings if f.code.startswith("dynamics.")]


STICK = [Drive(0, "input", ("d",), NARROW)]


def drawn(rng, noise):
    """Return spectral lines of a residual independent of its drive."""
    u = steps(rng)
    return lines_of(noise(rng), np.stack([u, np.arange(N) / N], axis=1), u[:, None])


def of_lines(rng):
    """Return noise of a turning rotor: two lines above white noise."""
    t = np.arange(N) * DT
    return rng.standard_normal(N) + 3.0 * np.sin(31.0 * t) + 2.0 * np.sin(6.1 * t + 1.0)


def of_a_hump(rng):
    return scipy.signal.lfilter([1.0], [1.0, -1.9, 0.95], rng.standard_normal(N))


@pytest.mark.parametrize("noise", [of_lines, of_a_hump])
def test_chance_makes_no_answer_whatever_the_spectrum(noise):
    rng = np.random.default_rng(11)
    p = [strongest([drawn(rng, noise)], STICK).p_value for _ in range(60)]
    # At 1 %, six of sixty occur once in a hundred thousand.
    assert np.sum(np.array(p) < 0.01) < 6


def test_wild_samples_that_happen_to_follow_the_stick_are_no_answer():
    rng = np.random.default_rng(0)
    u = steps(rng)
    e = rng.standard_normal(N)
    wild = rng.choice(N, 8, replace=False)
    e[wild] += 60.0 * np.sign(u[wild])
    full, part = (lines_of(e, np.ones((N, 1)), u[:, None], (), most) for most in (np.inf, 5.0))
    assert strongest([full], STICK).p_value < 0.01 < strongest([part], STICK).p_value
    assert part.size < 0.5 * full.size


def test_the_answer_through_a_filter_is_found_where_it_is():
    rng = np.random.default_rng(2)
    u = steps(rng)
    # Poles of 6 rad/s, damping 0.1.
    r, turn = np.exp(-0.1 * 6.0 * DT), 6.0 * np.sqrt(0.99) * DT
    answer = scipy.signal.lfilter([1.0], [1.0, -2.0 * r * np.cos(turn), r * r], u)
    e = rng.standard_normal(N) + 0.15 * answer / answer.std()
    lines = lines_of(e, u[:, None], u[:, None])
    found = strongest([lines], STICK)
    assert found.p_value < 0.01
    assert found.frequency / DT == pytest.approx(6.0, rel=0.1)
    assert found.damping == 0.1
    # The gain in twice the likelihood, by a least-squares fit of the known filter in time.
    columns = np.stack([u, np.ones(N), answer, np.roll(answer, 1)], axis=1)
    less = [np.sum((e - c @ np.linalg.lstsq(c, e)[0]) ** 2) for c in (columns[:, :2], columns)]
    assert found.statistic == pytest.approx(N * np.log(less[0] / less[1]), rel=0.25)
    # With the same filter of the drive, its cube explains nothing more.
    both = lines_of(e, u[:, None], np.stack([u, u**3], axis=1))
    assert strongest([both], [Drive(1, "amplitude", (), BROAD, (0,))]).p_value > 0.01


def wandering(rng):
    """Return a residual of gusts: slow, and far larger than each sample's innovation."""
    return scipy.signal.lfilter([1.0], [1.0, -1.99, 0.9905], rng.standard_normal(N))


def with_a_hole(values, first=700, count=40):
    return np.delete(values, slice(first, first + count), axis=0)


def test_a_hole_in_the_record_makes_no_answer():
    rng = np.random.default_rng(5)
    p, joined = [], []
    for _ in range(20):
        # Two independent slow signals: both jump where samples are missing.
        u, e = wandering(rng), wandering(rng)
        columns = [with_a_hole(v) for v in (e, np.arange(N)[:, None] / N, u[:, None])]
        p.append(strongest([lines_of(*columns, [700])], STICK).p_value)
        joined.append(strongest([lines_of(*columns)], STICK).p_value)
    assert np.sum(np.array(p) < 0.01) < 3
    # Without the gap's position most are taken for responses.
    assert np.sum(np.array(joined) < 0.01) > 10


def test_an_answer_is_found_beside_a_hole():
    rng = np.random.default_rng(6)
    u = steps(rng)
    answer = scipy.signal.lfilter([1.0], [1.0, -1.95, 0.96], u)
    e = rng.standard_normal(N) + 0.4 * answer / answer.std()
    columns = [with_a_hole(v) for v in (e, u[:, None], u[:, None])]
    assert strongest([lines_of(*columns, [700])], STICK).p_value < 0.001


def test_records_too_short_are_not_asked():
    assert lines_of(np.ones(40), np.ones((40, 1)), np.ones((40, 1))) is None
    e = np.random.default_rng(0).standard_normal(40)
    assert lines_of(e, np.ones((40, 1)), np.ones((40, 1))) is None


def test_squared_errors_of_responses_above_their_interval_are_said():
    said = []
    for chi_squared in (1.0, 1.9, 2.1):
        agreement = ResponseAgreement((), chi_squared, 0.75, 1.3, 100.0, 8.0, (), (), ())
        found = responses_explained(SimpleNamespace(responses=agreement, unrelated={}))
        said.append([(f.severity, f.value, f.denies) for f in found])
    assert said == [[], [("note", 1.9, False)], [("doubt", 2.1, True)]]
