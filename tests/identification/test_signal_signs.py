"""Consistency of signs, units and clocks of signals."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight
from heli_jax.identification.diagnostics.units import outputs_against_start, rate_against_angle
from heli_jax.identification.validation.signal_signs import against_start
from tests.identification.test_enough import DT, SWING, problem, response, steps

N = 1000
DEGREE = np.pi / 180.0


def moved(seed=0):
    """Return an oscillating angle by SciPy, and its rate, with sensor noise."""
    rng = np.random.default_rng(seed)
    u = steps(rng, N)
    phi, p = response(u, np.zeros(N))
    return u, phi + 0.003 * rng.standard_normal(N), p + 0.02 * rng.standard_normal(N)


def said(phi, p):
    u = np.zeros(N)
    flight = Flight(dt=DT, inputs={"u": u, "v": u}, outputs={"phi": phi, "p": p})
    asked = SimpleNamespace(
        flights=[("one", flight)], problem=problem(flight), status="not-converged", estimates={}
    )
    return list(rate_against_angle(asked))


def test_an_angle_that_moves_as_its_rate_says_nothing():
    for seed in range(20):
        _, phi, p = moved(seed)
        assert said(phi, p) == []
        # A bias, a gyro scale off by 1 %, and one in five samples of the angle.
        assert said(phi + 1.0, 1.01 * p - 0.3) == []
        assert said(np.where(np.arange(N) % 5 == 0, phi, np.nan), p) == []
        # Unrelated signals give no result.
        assert said(phi, moved(seed + 100)[2]) == []


@pytest.mark.parametrize(
    ("angle", "rate", "denies"),
    [
        (DEGREE, 1.0, True), (1.0, DEGREE, True), (-1.0, 1.0, True), (1.0, -DEGREE, True),
        (2.0, 1.0, False),
    ],
)  # fmt: skip
def test_a_wrong_sign_or_unit_of_an_angle_or_its_rate_is_said(angle, rate, denies):
    _, phi, p = moved()
    [found] = said(angle * phi, rate * p)
    assert (found.code, found.subjects) == ("signs.rate-against-angle", ("p", "phi"))
    assert found.value == pytest.approx(angle / rate, rel=0.05)
    # No model can follow reversed signs or other units, but it can absorb a scale.
    assert found.denies is denies


def test_a_rate_that_is_too_large_for_its_angle_is_said():
    for seed in range(5):
        _, phi, p = moved(seed)
        for scale in (1.25, 0.8, 0.93):
            [found] = said(phi, scale * p)
            assert (found.code, found.severity) == ("units.rate-scale", "doubt")
            assert found.value == pytest.approx(scale, rel=0.05)


def against(flight, run):
    return against_start([flight], [run])


def test_an_output_that_moves_against_the_simulated_one_is_said():
    u, phi, p = moved()
    for sign in (1.0, -1.0):
        inputs = {"u": sign * u, "v": np.zeros(N)}
        flight = Flight(dt=DT, inputs=inputs, outputs={"phi": phi, "p": p})
        # Wrong start values: a mode of 4 rad/s instead of 6, and half the effect.
        b, a, _ = scipy.signal.cont2discrete(([10.0], [1.0, 2.0, 16.0]), DT)
        guess = scipy.signal.lfilter(np.ravel(b), a, sign * u)
        run = {"phi": guess, "p": np.gradient(guess, DT)}
        assert list(against(flight, run)) == ([] if sign > 0 else ["phi", "p"])
    flight = Flight(dt=DT, inputs=inputs, outputs={"phi": -phi, "p": p})
    run = {n: -y for n, y in run.items()}
    assert list(against(flight, run)) == ["phi"]
    assert against(flight, {"phi": moved(7)[1], "p": moved(7)[2]}) == {}


def test_a_turned_output_is_a_doubt_before_a_fit_and_after_one_that_explains_little():
    held, run = swept_and_held()
    start = SimpleNamespace(simulated=[run])
    for fitted, denied, count in ((False, False, 1), (True, False, 0), (True, True, 1)):
        asked = SimpleNamespace(
            flights=[("held", held)], problem=SimpleNamespace(model=SWING), start=start,
            fitted=fitted, adequacy=SimpleNamespace(denied=denied),
        )  # fmt: skip
        found = list(outputs_against_start(asked))
        assert [f.code for f in found] == count * ["signs.against-start"]


def swept_and_held(seed=0, held_by=0.3, swept=0.0, sign=1.0):
    """Return a rate in gusts, held by a pilot with a delay of 0.1 s.

    It may also be swept. The second result is the response of a right model to the stick alone.
    """
    rng = np.random.default_rng(seed)
    u, p, answer = np.zeros(N), np.zeros(N), np.zeros(N)
    gust = scipy.signal.lfilter([1.0], [1.0, -0.98], 0.1 * rng.standard_normal(N))
    chirp = scipy.signal.chirp(np.arange(N) * DT, 0.3, N * DT, 2.0)
    for k in range(N - 1):
        u[k] = swept * chirp[k] - held_by * p[max(k - 5, 0)]
        p[k + 1] = p[k] + DT * (-2.0 * p[k] + 8.0 * u[k] + 4.0 * gust[k])
        answer[k + 1] = answer[k] + DT * (-2.0 * answer[k] + 8.0 * u[k])
    return Flight(dt=DT, inputs={"u": u}, outputs={"p": sign * p}), {"p": answer}


def test_a_stick_that_holds_in_one_flight_and_sweeps_in_another_has_the_right_sign():
    held, swept = swept_and_held(), swept_and_held(1, swept=1.0)
    # Alone it may be either, as the finding states.
    assert against(*held)["p"] < -0.3
    assert against_start([held[0], swept[0]], [held[1], swept[1]]) == {}
