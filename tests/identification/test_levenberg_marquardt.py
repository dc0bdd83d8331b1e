"""Levenberg-Marquardt: convergence, and the step after a refusal, against NumPy."""

import numpy as np
import pytest
import scipy.optimize

from heli_jax.identification.estimation.levenberg_marquardt import (
    Point,
    assess_step,
    predicted_gain,
    step_within,
)

RNG = np.random.default_rng(0)
J = RNG.standard_normal((12, 4)) * [1.0, 1e-4, 30.0, 1e3]
SIZES = np.linalg.norm(J, axis=0)
Y = np.array([1.0, 2.0, 3.0, 4.0])


def residual(gain, J=J, scale=1.0):
    """Return residuals with a part along the columns, so that a full step gains `gain`."""
    d = RNG.standard_normal(12)
    along = J @ np.linalg.lstsq(J, d, rcond=None)[0]
    return scale * (d - along) + along * np.sqrt(gain) / np.linalg.norm(along)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3])
def test_the_gain_is_what_a_full_step_takes_off(scale):
    assert predicted_gain(residual(1e-4, scale=scale), J, SIZES) == pytest.approx(1e-4, rel=1e-4)


def test_an_unknown_that_stays_put_has_no_gain():
    still = J * [1.0, 0.0, 1.0, 0.0]
    r = residual(1e-4, still[:, [0, 2]], scale=1e3)
    assert predicted_gain(r, still, SIZES * [1, 0, 1, 0]) == pytest.approx(1e-4, rel=1e-4)


def test_what_is_no_number_has_not_converged():
    assert predicted_gain(np.full(12, np.nan), J, SIZES) == np.inf


def test_the_step_within_a_radius_is_that_of_a_constrained_optimiser():
    r = residual(1e4)
    at = Point(Y, r, J, r @ r)
    full = -np.linalg.lstsq(J, r, rcond=None)[0]
    np.testing.assert_allclose(step_within(at, SIZES, np.inf, 1e-14), full, rtol=1e-6)
    radius = 0.3 * np.linalg.norm(SIZES * full)
    found = step_within(at, SIZES, radius, 1e-14)
    length = np.linalg.norm(SIZES * found)
    assert length == pytest.approx(radius, rel=0.2)
    best = scipy.optimize.minimize(
        lambda v: 0.5 * np.sum((r + J @ (v / SIZES)) ** 2),
        np.zeros(4),
        constraints={"type": "ineq", "fun": lambda v: length**2 - v @ v},
        tol=1e-12,
    )
    np.testing.assert_allclose(found * SIZES, best.x, atol=1e-4 * radius)


def test_a_fixed_unknown_keeps_its_value():
    r = residual(1.0)
    assert step_within(Point(Y, r, J, r @ r), SIZES * [1, 0, 1, 1], 0.1, 1e-12)[1] == 0.0


def assessed(r, step, cost, radius=np.inf):
    """Assess a step to a point with half the sum of squares equal to `cost`."""
    trial = Point(Y + step, np.full(12, np.nan), J, 2.0 * cost)
    return assess_step(Point(Y, r, J, r @ r), trial, SIZES, radius)


def test_the_step_after_a_rejected_one_is_shorter():
    r = residual(1.0)
    step = -np.linalg.lstsq(J, r, rcond=None)[0]
    begin, slope, length = 0.5 * r @ r, r @ J @ step, np.linalg.norm(SIZES * step)
    # The parabola through cost and slope here and the cost there has its minimum at a third.
    accepted, radius = assessed(r, step, begin - 0.5 * slope)
    assert not accepted
    assert radius == pytest.approx(length / 3.0)
    # At the ends of the sensible range, and for NaN.
    assert assessed(r, step, begin)[1] == pytest.approx(0.5 * length)
    for much in (1e6, np.inf, np.nan):
        assert assessed(r, step, begin - much * slope)[1] == pytest.approx(0.1 * length)


def test_the_radius_grows_with_steps_that_do_as_predicted():
    r = residual(1.0)
    step = -np.linalg.lstsq(J, r, rcond=None)[0] / 3.0
    begin, slope, length = 0.5 * r @ r, r @ J @ step, np.linalg.norm(SIZES * step)
    predicted = slope + 0.5 * np.sum((J @ step) ** 2)
    assert assessed(r, step, begin + predicted, length) == (True, pytest.approx(3.0 * length))
    assert assessed(r, step, begin + 0.5 * predicted, length) == (True, pytest.approx(length))
