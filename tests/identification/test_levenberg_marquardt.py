"""Levenberg-Marquardt: convergence, and the step after a refusal, against NumPy."""

import numpy as np
import pytest

from heli_jax.identification.estimation.levenberg_marquardt import (
    Point,
    Region,
    assess_step,
    predicted_gain,
)

RNG = np.random.default_rng(0)
J = RNG.standard_normal((12, 4)) * [1.0, 1e-4, 30.0, 1e3]
SIZES = np.linalg.norm(J, axis=0)
Y = np.array([1.0, 2.0, 3.0, 4.0])
BEGUN = Region(1e-5, np.inf)


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


def judged(r, step, cost, region=BEGUN):
    """Judge a step to a point with half the sum of squares equal to `cost`."""
    reached = Point(Y + step, np.full(12, np.nan), J, 2.0 * cost)
    return assess_step(Point(Y, r, J, r @ r), reached, region)


def test_the_step_after_a_refused_one_is_shorter():
    r = residual(1.0)
    step = -np.linalg.lstsq(J, r, rcond=None)[0]
    begin, slope, change = 0.5 * r @ r, r @ J @ step, np.linalg.norm(J @ step)
    # The parabola through cost and slope here and the cost there has its minimum at a third.
    accept, region = judged(r, step, begin - 0.5 * slope)
    assert not accept
    assert region.damping > BEGUN.damping
    assert region.radius == pytest.approx(change / 3.0)
    # At the ends of the sensible range, and for NaN.
    assert judged(r, step, begin)[1].radius == pytest.approx(0.5 * change)
    for much in (1e6, np.inf, np.nan):
        assert judged(r, step, begin - much * slope)[1].radius == pytest.approx(0.1 * change)


def test_the_radius_grows_with_steps_that_do_as_predicted():
    r = residual(1.0)
    step = -np.linalg.lstsq(J, r, rcond=None)[0]
    begin, slope, change = 0.5 * r @ r, r @ J @ step, np.linalg.norm(J @ step)
    _, region = judged(r, step, begin - 0.5 * slope)
    part = step / 3.0
    predicted = slope / 3.0 + 0.5 * np.sum((J @ part) ** 2)
    accept, grown = judged(r, part, begin + predicted, region)
    assert accept
    assert grown.radius == pytest.approx(change)
    assert grown.damping < region.damping
    accept, same = judged(r, part, begin + 0.5 * predicted, region)
    assert accept
    assert same == region
