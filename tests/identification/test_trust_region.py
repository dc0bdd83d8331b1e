"""When a search has arrived, and how far it goes after a step that was refused: against NumPy."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest

from heli_jax.identification.estimation.levenberg_marquardt import (
    ARRIVED,
    REGION,
    gain_ahead,
    within_radius,
)

RNG = np.random.default_rng(0)
J = RNG.standard_normal((12, 4)) * [1.0, 1e-4, 30.0, 1e3]


class State(NamedTuple):
    """What of optimistix's state is asked for."""

    y_eval: Any
    f_info: Any
    search_state: Any


def at(r, J=J):
    jac = lx.MatrixLinearOperator(jnp.asarray(J))
    return optx.FunctionInfo.ResidualJac(jnp.asarray(r), jac)


def residual(gain, J=J, scale=1.0):
    """Orthogonal to the columns, and along them so much that a full step takes off `gain`."""
    d = RNG.standard_normal(12)
    along = J @ np.linalg.lstsq(J, d, rcond=None)[0]
    return scale * (d - along) + along * np.sqrt(gain) / np.linalg.norm(along)


def arrived(f_info, residual_norm):
    return gain_ahead(f_info, residual_norm) < ARRIVED


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3])
def test_a_search_has_arrived_within_a_hundredth_of_a_standard_deviation(scale):
    one = jnp.asarray(1.0)
    assert arrived(at(residual(0.9e-4, scale=scale)), one)
    assert not arrived(at(residual(1.1e-4, scale=scale)), one)
    # Residuals are handed over divided by their norm.
    r = residual(0.9e-4, scale=scale) / 5.0
    assert arrived(at(r), jnp.asarray(5.0))
    assert not arrived(at(r), jnp.asarray(6.0))


def test_an_unknown_that_stays_put_has_no_gain():
    still = J * [1.0, 0.0, 1.0, 0.0]
    for gain in (0.9e-4, 1.1e-4):
        r = residual(gain, still[:, [0, 2]], scale=1e3)
        assert bool(arrived(at(r, still), jnp.asarray(1.0))) == (gain < 1e-4)


def test_what_is_no_number_has_not_arrived():
    assert not arrived(at(np.full(12, np.nan)), jnp.asarray(1.0))


Y = np.array([1.0, 2.0, 3.0, 4.0])


def begun():
    return REGION.init(jnp.asarray(Y), None)


def judged(r, step, cost, region=None, first=False):
    """What the trust region says of a step to where half the sum of squares is `cost`."""
    reached = at(np.full(12, np.sqrt(cost / 6.0)))
    region = begun() if region is None else region
    step_size, accept, _, new = REGION.step(
        jnp.asarray(first), jnp.asarray(Y), jnp.asarray(Y + step), at(r), reached, region
    )
    assert step_size == new.step_size
    return bool(accept), new


def cut(r, step, region):
    """What is left of the next step."""
    state = State(jnp.asarray(Y + step), at(r), region)
    return np.asarray(within_radius(state, jnp.asarray(Y)).y_eval) - Y


def test_the_step_after_a_refused_one_is_shorter():
    r = residual(1.0)
    step = -np.linalg.lstsq(J, r, rcond=None)[0]
    begin, slope = 0.5 * r @ r, r @ J @ step
    assert cut(r, 1e9 * step, begun()) == pytest.approx(1e9 * step)
    # The parabola through cost and slope here, and the cost there, has its lowest point at a third.
    accept, region = judged(r, step, begin - 0.5 * slope)
    assert not accept
    assert region.step_size < begun().step_size
    assert cut(r, step, region) == pytest.approx(step / 3.0)
    # Not in a direction that the data leave open: there is no size of that.
    assert cut(r, 0.3 * step, region) == pytest.approx(0.3 * step)
    # Near the ends of what is sensible, and where there is no number at all.
    assert cut(r, step, judged(r, step, begin)[1]) == pytest.approx(0.5 * step)
    for much in (1e6, np.inf, np.nan):
        assert cut(r, step, judged(r, step, begin - much * slope)[1]) == pytest.approx(0.1 * step)


def test_the_radius_grows_with_steps_that_do_as_predicted():
    r = residual(1.0)
    step = -np.linalg.lstsq(J, r, rcond=None)[0]
    begin, slope = 0.5 * r @ r, r @ J @ step
    _, region = judged(r, step, begin - 0.5 * slope)
    part = step / 3.0
    predicted = slope / 3.0 + 0.5 * np.sum((J @ part) ** 2)
    accept, grown = judged(r, part, begin + predicted, region)
    assert accept
    assert cut(r, 9.0 * part, grown) == pytest.approx(3.0 * part)
    accept, same = judged(r, part, begin + 0.5 * predicted, region)
    assert accept
    assert cut(r, 9.0 * part, same) == pytest.approx(part)
