"""When a search has arrived, and how far it goes after a step that was refused: against NumPy."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest

from heli_jax.identification.estimation.trust_region import arrived, shortened

RNG = np.random.default_rng(0)
J = RNG.standard_normal((12, 4)) * [1.0, 1e-4, 30.0, 1e3]
ALL = jnp.ones(4, bool)


class State(NamedTuple):
    """What of optimistix's state is asked for."""

    y_eval: Any
    f_info: Any
    num_steps_since_acceptance: Any


def at(r, J=J):
    jac = lx.MatrixLinearOperator(jnp.asarray(J))
    return optx.FunctionInfo.ResidualJac(jnp.asarray(r), jac)


def residual(gain, J=J, scale=1.0):
    """Orthogonal to the columns, and along them so much that a full step takes off `gain`."""
    d = RNG.standard_normal(12)
    along = J @ np.linalg.lstsq(J, d, rcond=None)[0]
    return scale * (d - along) + along * np.sqrt(gain) / np.linalg.norm(along)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3])
def test_a_search_has_arrived_within_a_hundredth_of_a_standard_deviation(scale):
    one = jnp.asarray(1.0)
    assert arrived(at(residual(0.9e-4, scale=scale)), ALL, one)
    assert not arrived(at(residual(1.1e-4, scale=scale)), ALL, one)
    # Residuals are handed over divided by their norm.
    r = residual(0.9e-4, scale=scale) / 5.0
    assert arrived(at(r), ALL, jnp.asarray(5.0)) and not arrived(at(r), ALL, jnp.asarray(6.0))


def test_unknowns_that_do_not_count_are_projected_out():
    mask = np.array([True, False, True, True])
    off = J @ np.array([0.0, 3e4, 0.0, 0.0])
    assert not arrived(at(residual(1e-6) + off), ALL, jnp.asarray(1.0))
    assert arrived(at(residual(1e-6) + off), jnp.asarray(mask), jnp.asarray(1.0))
    # Not left out: what the others could take over is no gain of theirs.
    first = np.column_stack([J[:, 1] + 1e-7 * J[:, 0], J[:, 1:]])
    assert arrived(at(residual(1e-6, first) + off, first), jnp.asarray(mask), jnp.asarray(1.0))


def test_an_unknown_that_stays_put_has_no_gain():
    still = J * [1.0, 0.0, 1.0, 0.0]
    for gain in (0.9e-4, 1.1e-4):
        r = residual(gain, still[:, [0, 2]], scale=1e3)
        assert bool(arrived(at(r, still), ALL, jnp.asarray(1.0))) == (gain < 1e-4)


def test_what_is_no_number_has_not_arrived():
    assert not arrived(at(np.full(12, np.nan)), ALL, jnp.asarray(1.0))


def after(r, tried, following, cost, refused=True):
    y = np.array([1.0, 2.0, 3.0, 4.0])
    state = State(jnp.asarray(y + following), at(r), jnp.asarray(int(refused)))
    new = shortened(state, jnp.asarray(y), jnp.asarray(y + tried), jnp.asarray(cost))
    return np.asarray(new.y_eval) - y


def test_the_step_after_a_refused_one_is_shorter():
    r = residual(1.0)
    tried = -np.linalg.lstsq(J, r, rcond=None)[0]
    begin, slope = 0.5 * r @ r, r @ J @ tried
    # The parabola through cost and slope here, and the cost there, has its lowest point at a third.
    cost = begin + 0.5 * slope * (2.0 - 3.0)
    assert after(r, tried, tried, cost) == pytest.approx(tried / 3.0)
    # Near the ends of what is sensible, and where there is no number at all.
    assert after(r, tried, tried, begin + 1e-9 * slope) == pytest.approx(0.5 * tried)
    for much in (1e6, np.inf, np.nan):
        assert after(r, tried, tried, begin - much * slope) == pytest.approx(0.1 * tried)
    # Damping may have shortened it by itself; then it stays, in the direction that it has.
    turned = 0.01 * tried * [1.0, 2.0, 1.0, 1.0]
    assert after(r, tried, turned, cost) == pytest.approx(turned)
    # A step that was accepted has no say in the next.
    assert after(r, tried, 7.0 * tried, cost, refused=False) == pytest.approx(7.0 * tried)
