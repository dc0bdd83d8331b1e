"""Bounded parameters as unbounded coordinates: inverse, bounds, monotonicity."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from heli_jax import Free
from heli_jax.identification.unknowns.transforms import (
    KINDS,
    coordinate_limits,
    coordinates,
    inside,
    kind,
    limits,
    sign_or_scale,
    to_coordinate,
    to_value,
)

sizes = st.floats(1e-6, 1e6)
widths = st.floats(1e-3, 1e3)
shares = st.floats(1e-6, 1.0 - 1e-6)
signs = st.sampled_from([-1.0, 1.0])


@st.composite
def cases(draw):
    """Return (kind, sign, low, high, a value inside)."""
    how, sign = draw(st.sampled_from(KINDS)), draw(signs)
    size, width, share = draw(sizes), draw(widths), draw(shares)
    if how == "log":
        return how, sign, -math.inf, math.inf, sign * size
    if how == "linear":
        return how, size, -math.inf, math.inf, sign * width * size
    low = sign * size
    high = low + width * size
    return how, sign, low, high, low + share * (high - low)


@given(cases())
def test_there_and_back(case):
    how, sign, low, high, x = case
    z = to_coordinate(how, jnp.asarray(x), sign, low, high)
    assert np.isfinite(z)
    back = float(to_value(how, z, sign, low, high))
    scale = max(
        abs(x), abs(low) if math.isfinite(low) else 0, abs(high) if math.isfinite(high) else 0
    )
    assert back == pytest.approx(x, rel=1e-9, abs=1e-10 * scale)


@given(cases(), st.floats(-30.0, 30.0))
def test_every_coordinate_is_inside(case, z):
    how, sign, low, high, _ = case
    x = float(to_value(how, jnp.asarray(z), sign, low, high))
    edge = 1e-12 * max(abs(v) for v in (low, high, 0.0) if math.isfinite(v))
    assert low - edge <= x <= high + edge
    if how == "log":
        assert x * sign > 0


@given(cases(), st.floats(-8.0, 8.0), st.floats(1e-3, 3.0))
def test_monotone(case, z, step):
    how, sign, low, high, _ = case
    one, two = (float(to_value(how, jnp.asarray(v), sign, low, high)) for v in (z, z + step))
    assume(math.isfinite(one) and math.isfinite(two))
    assert two >= one if how != "log" or sign > 0 else two <= one


@pytest.mark.parametrize("how", KINDS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_derivative_is_finite_and_that_of_differences(how, sign):
    low, high = (1.0, 3.0) if sign > 0 else (-3.0, -1.0)
    for z in (-5.0, 0.0, 0.7, 5.0):
        slope = float(jax.grad(lambda z: to_value(how, z, sign, low, high))(jnp.asarray(z)))
        h = 1e-6
        up, down = (float(to_value(how, jnp.asarray(z + d), sign, low, high)) for d in (h, -h))
        assert slope == pytest.approx((up - down) / (2.0 * h), rel=1e-5, abs=1e-9)
        assert slope != 0.0


@pytest.mark.parametrize(
    ("free", "wanted", "bounds"),
    [
        (Free(2.0), "log", (0.0, math.inf)),
        (Free(-2.0), "log", (-math.inf, 0.0)),
        (Free(2.0, lower=1.0), "log", (1.0, math.inf)),
        (Free(2.0, lower=-1.0), "log", (-1.0, math.inf)),
        (Free(-2.0, upper=-1.0), "log", (-math.inf, -1.0)),
        (Free(-2.0, upper=1.0), "log", (-math.inf, 1.0)),
        (Free(2.0, upper=3.0), "log", (0.0, 3.0)),
        (Free(-2.0, lower=-3.0), "log", (-3.0, 0.0)),
        (Free(2.0, 1.0, 3.0), "log", (1.0, 3.0)),
        (Free(-2.0, -3.0, -1.0), "log", (-3.0, -1.0)),
        (Free(0.5, -1.0, 1.0), "logit", (-1.0, 1.0)),
        (Free(0.5, 0.0, 1.0), "log", (0.0, 1.0)),
        (Free(2.0, sign="any"), "linear", (-math.inf, math.inf)),
        (Free(0.0, sign="any"), "linear", (-math.inf, math.inf)),
        (Free(2.0, upper=3.0, sign="any"), "linear", (-math.inf, 3.0)),
        (Free(-2.0, lower=-3.0, sign="any"), "linear", (-3.0, math.inf)),
        (Free(2.0, lower=1.0, sign="any"), "log", (1.0, math.inf)),
        (Free(2.0, 1.0, 3.0, sign="any"), "log", (1.0, 3.0)),
        (Free(0.5, -1.0, 1.0, sign="any"), "logit", (-1.0, 1.0)),
    ],
)
def test_kind_and_limits(free, wanted, bounds):
    assert kind(free) == wanted
    assert limits(free) == bounds
    limits_of_z = coordinate_limits(wanted, sign_or_scale(free), *bounds)
    assert limits_of_z[0] < float(coordinates(free, wanted, free.start)) < limits_of_z[1]
    for edge in bounds:
        if math.isfinite(edge) and wanted != "logit" and edge * free.start > 0:
            assert np.any(np.isclose(limits_of_z, float(coordinates(free, wanted, edge))))
    assert inside(free, free.start)
    for edge in bounds:
        if math.isfinite(edge):
            assert inside(free, edge)
            assert not inside(free, edge + (-1e-6 if edge == bounds[0] else 1e-6))
