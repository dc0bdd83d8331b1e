"""The response of linear models at the lines of a record, against NumPy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight
from heli_jax.flights.flight import own_instruments
from heli_jax.identification.estimation.frequency_lines import (
    Driving,
    Matrices,
    Record,
    at_each_line,
    at_lines,
    ends_of,
    errors_of_record,
    modelled,
    projection,
    sources,
)


@pytest.mark.parametrize("samples", [90, 91])
def test_every_run_of_a_model_is_its_response_at_the_lines_and_the_effects_of_the_ends(samples):
    rng = np.random.default_rng(samples)
    # An unstable mode, an integrator and a lag.
    A = np.array([[1.08, 0.0, 0.1], [0.3, 1.0, 0.0], [0.0, 0.0, 0.7]])
    B, C, D = (rng.standard_normal(s) for s in ((3, 2), (2, 3), (2, 2)))
    U, x = rng.standard_normal((samples, 2)), rng.standard_normal(3)
    machine = Matrices(*(jnp.asarray(v) for v in (A, B, C, D)))
    signals = Driving(jnp.asarray(U), jnp.asarray(U))
    y, first = np.zeros((samples, 2)), x
    for k in range(samples):
        y[k] = C @ x + D @ U[k]
        x = A @ x + B @ U[k]
    record = Record(0, 0, samples)
    z, R = at_lines(machine, record)
    expected = np.linalg.inv(np.asarray(z)[:, None, None] * np.eye(3) - A)
    np.testing.assert_allclose(R, expected, rtol=1e-10)
    here = sources(record, jax.tree.map(lambda v: v[None], signals))
    ends = z[:, None] * jnp.asarray(first - x + 0j)[None] / samples**0.5
    lines = np.fft.rfft(y, axis=0)[1 : (samples + 1) // 2] / samples**0.5
    made = at_each_line(partial(modelled, machine), R, here._replace(ends=ends[:, :, None]))
    np.testing.assert_allclose(made[:, :, 0], lines, atol=1e-8 * np.max(np.abs(lines)))
    # Least squares finds the effects of the ends.
    W = jnp.broadcast_to(jnp.eye(2, dtype=complex), (len(z), 2, 2))
    transforms = jnp.asarray(lines)[:, :, None]
    at = ends_of(machine, record, W, here, transforms)
    left = errors_of_record(machine, W, at.R, here._replace(ends=at.inputs), transforms)
    for errors in (left, at.errors):
        np.testing.assert_allclose(errors, 0.0, atol=1e-8 * np.max(np.abs(lines)))


def test_a_state_that_no_output_shows_adds_nothing():
    """Test a parameter whose effect is rounding: its column must remove nothing from the errors."""
    rng = np.random.default_rng(2)
    basis = rng.standard_normal((40, 3))
    basis[:, 1] = 1e-15 * rng.standard_normal(40)
    Q, S = (np.asarray(v) for v in projection(jnp.asarray(basis)))
    shown, _ = np.linalg.qr(basis[:, [0, 2]])
    np.testing.assert_allclose(Q @ Q.T, shown @ shown.T, atol=1e-12)
    assert not S[1].any()


def test_slopes_of_the_response_are_those_of_the_whole_expression():
    """Though the inverse for each line has no derivative of its own."""
    rng, record = np.random.default_rng(7), Record(0, 0, 60)
    shapes = ((3, 3), (3, 2), (2, 3), (2, 2), (60, 2), (60, 2))
    here, along = ([jnp.asarray(rng.standard_normal(s)) for s in shapes] for _ in range(2))
    ends = jnp.asarray(rng.standard_normal(3)).astype(complex)
    z = np.exp(2j * np.pi * np.arange(1, 30) / 60)

    def outputs(*v):
        m, signals = Matrices(*v[:4]), Driving(*v[4:])
        here = sources(record, jax.tree.map(lambda v: v[None], signals))
        here = here._replace(ends=(jnp.asarray(z)[:, None] * ends[None])[:, :, None])
        return at_each_line(partial(modelled, m), at_lines(m, record)[1], here)[:, :, 0]

    def plain(A, B, C, D, U, acting):
        lines, passing = (jnp.fft.rfft(v, axis=0)[1:30] / 60**0.5 for v in (U, acting))
        driving = lines @ B.T + z[:, None] * ends[None]
        resolvent = z[:, None, None] * np.eye(3)[None] - A[None]
        X = jnp.linalg.solve(resolvent, driving[:, :, None])[:, :, 0]
        return X @ C.T + passing @ D.T

    made = jax.jvp(outputs, here, along)
    with jax.numpy_dtype_promotion("standard"):
        whole = jax.jvp(plain, here, along)
    for one, expected in zip(made, whole, strict=True):
        np.testing.assert_allclose(one, expected, atol=1e-9 * np.max(np.abs(expected)))


def test_a_stick_is_no_instrument_of_itself():
    u, r = np.random.default_rng(1).standard_normal((2, 50))

    def flight(by):
        return Flight(dt=0.1, inputs={"lat": u}, outputs={"p": u}, instruments={"lat": by})

    assert own_instruments([flight(3.0 * u - 1.0)], ["lat"]) == ("lat",)
    # An open-loop flight beside others is not a loop.
    assert own_instruments([flight(u), flight(r)], ["lat"]) == ()
