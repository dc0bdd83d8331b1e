"""Vehicles with memory longer than a window, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import Flight
from heli_jax.flights.flight import own_instruments
from heli_jax.identification.estimation.frequency_lines import Driving, Matrices, orthonormal
from heli_jax.identification.estimation.frequency_response import (
    bounded_outputs,
    effects_of_ends,
    inverses,
)


def test_every_run_of_a_machine_is_its_bounded_solution_and_what_the_ends_add():
    samples = 91
    rng = np.random.default_rng(samples)
    # An unstable mode, an integrator and a lag.
    A = np.array([[1.08, 0.0, 0.1], [0.3, 1.0, 0.0], [0.0, 0.0, 0.7]])
    B, C, D = (rng.standard_normal(s) for s in ((3, 2), (2, 3), (2, 2)))
    U, x = rng.standard_normal((samples, 2)), rng.standard_normal(3)
    machine = Matrices(*(jnp.asarray(v) for v in (A, B, C, D)))
    signals = Driving(jnp.asarray(U), jnp.asarray(U))
    y = np.zeros((2, samples))
    for k in range(samples):
        y[:, k] = C @ x + D @ U[k]
        x = A @ x + B @ U[k]
    at = inverses(machine, samples)
    left = (y - np.asarray(bounded_outputs(machine, signals, at))).ravel()
    basis = np.moveaxis(np.asarray(effects_of_ends(machine, at, samples)), 1, 0).reshape(3, -1).T
    ends = np.linalg.lstsq(basis, left, rcond=None)[0]
    whole = np.asarray(bounded_outputs(machine, signals, at, jnp.asarray(ends)))
    np.testing.assert_allclose(whole, y, atol=1e-8 * np.max(np.abs(y)))
    S = np.asarray(orthonormal(jnp.asarray(basis.T @ basis)))
    np.testing.assert_allclose(S @ (S.T @ (basis.T @ left)), ends, rtol=1e-6)


def test_a_state_that_no_output_shows_adds_nothing():
    """Test a parameter whose effect is rounding: its column must remove nothing from the errors."""
    rng = np.random.default_rng(2)
    basis = rng.standard_normal((40, 3))
    basis[:, 1] = 1e-15 * rng.standard_normal(40)
    S = np.asarray(orthonormal(jnp.asarray(basis.T @ basis)))
    Q = basis @ S
    shown, _ = np.linalg.qr(basis[:, [0, 2]])
    np.testing.assert_allclose(Q @ Q.T, shown @ shown.T, atol=1e-12)
    assert not S[1].any()


def test_slopes_of_the_bounded_solution_are_those_of_the_whole_expression():
    """Test derivatives, although the inverse for each line has none."""
    rng = np.random.default_rng(7)
    shapes = ((3, 3), (3, 2), (2, 3), (2, 2), (60, 2), (60, 2))
    here, along = ([jnp.asarray(rng.standard_normal(s)) for s in shapes] for _ in range(2))
    ends, turns = jnp.asarray(rng.standard_normal(3)), np.exp(1j * np.pi * np.arange(60) / 60)
    z = np.exp(1j * np.pi * (2 * np.arange(60) + 1) / 60)

    def outputs(*v):
        m, signals = Matrices(*v[:4]), Driving(*v[4:])
        return bounded_outputs(m, signals, inverses(m, 60), ends)

    def plain(A, B, C, D, U, acting):
        lines = jnp.fft.fft(U * turns.conj()[:, None], axis=0)
        driving = lines @ B.T + z[:, None] * ends[None]
        resolvent = z[:, None, None] * np.eye(3)[None] - A[None]
        X = jnp.linalg.solve(resolvent, driving[:, :, None])[:, :, 0]
        return jnp.real(jnp.fft.ifft(C @ X.T, axis=1) * turns[None]) + D @ acting.T

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
