"""Translated programs against JAX, by operations and by random expressions."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heli_jax.fused.code import UnsupportedError
from heli_jax.fused.kernel import Argument, Kernel, Run

LANES, N = 8, 5
RECORD = np.array([0.3, -0.7, 1.1, 0.2, -0.4])


def compiled(step, stays, carry, dtype=np.float64, vehicles=LANES, threads=1):
    """Return the carry after N samples, by the program and by JAX for each vehicle.

    Args:
        step: function of (constants, record, carry, sample).
        stays: constants: an array with the vehicles last, or a number for all.
        carry: an array (vehicles,).
    """
    stays = [np.asarray(v, dtype) for v in stays]
    record = RECORD.astype(dtype)
    one = [v[..., 0] if v.ndim else v for v in stays]
    sample = np.zeros((), np.int32)
    whole = jax.make_jaxpr(lambda s, u, x, k: step(s, u, x, k))
    last = jax.make_jaxpr(lambda s, u, x: step(s, u, x, jnp.int32(N - 1)))
    run = Run(
        whole(one, record, carry[0], sample),
        last(one, record, carry[0]),
        tuple(
            Argument(w.shape, np.dtype(dtype), v.ndim == 0) for v, w in zip(stays, one, strict=True)
        ),
        (Argument((N,), np.dtype(dtype), True),),
        (Argument((), np.dtype(dtype), False),),
        N - 1,
    )
    found = Kernel(run, LANES)(stays, [record], [carry], threads)
    return found[0], by_jax(step, stays, carry, vehicles)


def by_jax(step, stays, carry, vehicles=LANES):
    """Return the same by JAX alone; arguments as in `compiled`."""

    def alone(i):
        own = [jnp.asarray(v[..., i] if np.ndim(v) else v, carry.dtype) for v in stays]
        x, record = jnp.asarray(carry[i]), jnp.asarray(RECORD, carry.dtype)
        for k in range(N):
            x = step(own, record, x, jnp.int32(k))
        return np.asarray(x)

    return np.stack([alone(i) for i in range(vehicles)], axis=-1)


def agree(step, stays=None, dtype=np.float64, low=-2.0, high=2.0, rtol=None):
    rng = np.random.default_rng(1)
    stays = [rng.uniform(0.5, 1.5, LANES), 0.7] if stays is None else stays
    carry = rng.uniform(low, high, LANES).astype(dtype)
    found, expected = compiled(step, stays, carry, dtype)
    assert found.dtype == expected.dtype == dtype
    rtol = (1e-12 if dtype == np.float64 else 2e-5) if rtol is None else rtol
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol)


UNARY = {
    name: getattr(jnp, name)
    for name in (
        *("sin", "cos", "tan", "exp", "exp2", "arctan", "tanh", "sinh", "cosh", "floor", "ceil"),
        *("round", "sign", "abs", "square", "negative"),
    )
} | {
    "sqrt": lambda x: jnp.sqrt(jnp.abs(x)),
    "log": lambda x: jnp.log(1.0 + jnp.abs(x)),
    "rsqrt": lambda x: jax.lax.rsqrt(1.0 + x * x),
    "arcsin": lambda x: jnp.arcsin(jnp.tanh(x)),
    "arccos": lambda x: jnp.arccos(jnp.tanh(x)),
    "sigmoid": jax.nn.sigmoid,
    "power": lambda x: jnp.power(1.0 + x * x, 0.3),
    "cube": lambda x: x**3,
    "inverse square": lambda x: (2.0 + x) ** -2,
    "clip": lambda x: jnp.clip(x, -0.5, 0.5),
    "where": lambda x: jnp.where(x > 0.1, x, -2.0 * x),
    "isfinite": lambda x: jnp.where(jnp.isfinite(1.0 / (x - x)), 1.0, x),
    "logic": lambda x: jnp.where(((x > 0) & ~(x > 1)) | (x < -1), x, 0.5 * x),
    "atan2": lambda x: jnp.arctan2(x, x - 0.5),
    "minimum": lambda x: jnp.minimum(x, 0.3) + jnp.maximum(x, -0.2),
}
# A program of several compiles as fast as one of one.
GROUPS = {
    "slopes": lambda x: sum(
        jax.grad(f)(x)
        for f in (
            jnp.tanh,
            lambda v: jnp.arcsin(0.4 * v),
            lambda v: jnp.arccos(0.4 * v),
            lambda v: v * jax.lax.stop_gradient(v),
            lambda v: v % 0.7,
        )
    ),
    "remainders": lambda x: jnp.mod(x, 0.7) + jnp.fmod(x, -0.3) + jnp.remainder(x, -0.45),
    "truth values": lambda x: jnp.where(
        jnp.maximum(x > 0, x > 1), 1.0, jnp.where(jnp.minimum(x > -1, x < -0.5), 2.0, x)
    ),
}


def _several(names, count=4):
    """Return a program of a few, which compiles as fast as one of one."""
    return [tuple(names)[i::count] for i in range(count)]


@pytest.mark.parametrize("names", _several([*UNARY, *GROUPS]), ids=",".join)
def test_operations(names):
    def step(stays, u, x, k):
        z = stays[0] * x + u[k]
        return 0.3 * sum(jnp.tanh((UNARY | GROUPS)[n](z)) for n in names) / len(names) + stays[1]

    agree(step)


# tests/sweeps/test_fused.py compares sweeps in single precision.
@pytest.mark.slow
def test_records_and_loops():
    def step(stays, u, x, k):
        a, b = stays
        # Clipped, as in the simulation; before the first sample the first applies.
        before = u[jnp.clip(k - 1, 0, N - 1)]
        late = 2.0 * u + a  # a function of a whole record is computed for the element read
        total, _ = jax.lax.scan(lambda c, r: (c + 0.1 * r * jnp.sin(c + a), None), b * x, u)
        inner = jax.lax.fori_loop(0, 3, lambda i, y: 0.5 * y + 0.1 * i, before)
        inner = jax.lax.fori_loop(0, 0, lambda i, y: y + 1.0, inner)
        chosen = jax.lax.cond(x > 0, lambda y: y, lambda y: -2.0 * y, total)
        return 0.2 * (chosen + inner + late[k] + u[1:3][0])

    agree(step)


def test_what_is_not_a_number_stays_so():
    def step(stays, u, x, k):
        return jnp.maximum(jnp.where(k == 2, x - jnp.inf + jnp.inf, x), 0.0)

    found, expected = compiled(step, [np.ones(LANES), 1.0], np.linspace(-1, 1, LANES))
    assert np.isnan(expected).all()
    np.testing.assert_array_equal(found, expected)


def _drawn(s, u, x, k):
    return x + jax.random.uniform(jax.random.fold_in(jax.random.key(3), k))


def _called(s, u, x, k):
    # Not called during translation, although all its arguments are known.
    return x + jax.pure_callback(_never, jax.ShapeDtypeStruct((), float), jnp.zeros(()))


def _never(_):
    raise AssertionError("called while it was translated")


@pytest.mark.parametrize(
    "step",
    [
        lambda s, u, x, k: jax.scipy.special.erfinv(x),
        lambda s, u, x, k: jnp.sum(jnp.stack([x, 2 * x])),
        lambda s, u, x, k: u[jnp.floor(jnp.abs(x)).astype(int)],
        lambda s, u, x, k: jax.lax.reduce_precision(x, 5, 10),
        _drawn,
        _called,
    ],
)
def test_what_has_no_translation_is_named_with_its_line(step):
    with pytest.raises(UnsupportedError) as refused:
        compiled(step, [np.ones(LANES), 1.0], np.ones(LANES))
    assert refused.value.place.startswith("at test_kernel.py:")


@pytest.mark.parametrize("threads", [1, 2, 9])
def test_threads_share_the_vehicles(threads):
    def step(stays, u, x, k):
        return 0.9 * x + stays[0] * u[k]

    rng = np.random.default_rng(2)
    gains, carry = rng.uniform(0.5, 1.5, 64), rng.uniform(-1, 1, 64)
    found, expected = compiled(step, [gains, 1.0], carry, vehicles=64, threads=threads)
    np.testing.assert_allclose(found, expected, rtol=1e-13)


_SMOOTH = ("sin", "cos", "tanh", "arctan", "clip", "sqrt", "log", "square", "abs", "minimum")
_NEWER = {
    "loop": lambda v: jax.lax.fori_loop(0, 3, lambda i, y: 0.5 * y + 0.1 * i * v, v),
    "branch": lambda v: jax.lax.cond(v > 0, lambda y: 0.5 * y, lambda y: 2.0 * y, v),
    "remainder": lambda v: (v - 0.7 * jnp.floor(v / 0.7)) * (v - 0.7 * jnp.ceil(v / 0.7)),
}


@st.composite
def expressions(draw, depth=4):
    """Return random functions of (a, b, u, x), traceable by JAX, of bounded size."""
    if depth == 0 or (draw(st.booleans()) and depth < 3):
        pick = draw(st.integers(0, 4))
        number = draw(st.floats(-2, 2, allow_nan=False, width=32))
        return lambda *v: v[pick] if pick < 4 else jnp.asarray(number, v[3].dtype)
    if draw(st.booleans()):
        name, inner = draw(st.sampled_from((*_SMOOTH, *_NEWER))), draw(expressions(depth=depth - 1))
        function = _NEWER[name] if name in _NEWER else UNARY[name]
        return lambda *v: jnp.clip(function(inner(*v)), -50.0, 50.0)
    left, right = draw(expressions(depth=depth - 1)), draw(expressions(depth=depth - 1))
    how = draw(st.sampled_from(["+", "-", "*", "/", "min", "max"]))
    return {
        "+": lambda *v: left(*v) + right(*v),
        "-": lambda *v: left(*v) - right(*v),
        "*": lambda *v: left(*v) * right(*v),
        "/": lambda *v: left(*v) / (1.5 + right(*v) ** 2),
        "min": lambda *v: jnp.minimum(left(*v), right(*v)),
        "max": lambda *v: jnp.maximum(left(*v), right(*v)),
    }[how]


@settings(max_examples=3 if os.environ.get("CI") == "true" else 15, deadline=None)
@given(expressions())
def test_a_random_expression(expression):
    def once(stays, u, x):
        # The derivative is computed in the same way; it is bounded, since both may be large.
        def value(x):
            return expression(stays[0], stays[1], u, x)

        of, slope = jax.jvp(value, (x,), (jnp.ones_like(x),))
        return jnp.tanh(0.1 * of) + jnp.tanh(1e-3 * slope)

    rng = np.random.default_rng(1)
    gain, carry = rng.uniform(0.5, 1.5, LANES), rng.uniform(-2.0, 2.0, LANES)
    found, expected = compiled(
        lambda stays, u, x, k: jnp.where(k == 0, once(stays, u[k], x), x), [gain, 0.7], carry
    )

    # The tolerance is the effect of one unit in the last digit of the arguments.
    def at(gain, carry):
        return np.asarray(jax.vmap(lambda a, x: once([a, 0.7], RECORD[0], x))(gain, carry))

    near = [(np.nextafter(gain, 9.0), np.nextafter(carry, to)) for to in (9.0, -9.0)]
    spread = max(np.max(np.abs(at(*v) - at(gain, carry))) for v in near)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 + 30.0 * spread)
