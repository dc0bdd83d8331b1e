"""Machines that remember longer than a window, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight
from heli_jax.flights.instruments import own_instruments
from heli_jax.identification.estimation.response_weights import Machine
from heli_jax.identification.estimation.window_errors import (
    bounded_outputs,
    driven_by,
    ends_outputs,
    output_slopes,
    resolved,
    span,
)


def test_every_run_of_a_machine_is_its_bounded_solution_and_what_the_ends_add():
    samples = 91
    rng = np.random.default_rng(samples)
    # An unstable mode, an integrator and a lag.
    A = np.array([[1.08, 0.0, 0.1], [0.3, 1.0, 0.0], [0.0, 0.0, 0.7]])
    B, C, D = (rng.standard_normal(s) for s in ((3, 2), (2, 3), (2, 2)))
    U, x = rng.standard_normal((samples, 2)), rng.standard_normal(3)
    machine = Machine(*(jnp.asarray(v) for v in (A, B, U, U, C, D, x)))
    y = np.zeros((2, samples))
    for k in range(samples):
        y[:, k] = C @ x + D @ U[k]
        x = A @ x + B @ U[k]
    at = resolved(machine.Ad, machine.C, samples)
    left = (y - np.asarray(bounded_outputs(machine, driven_by(machine, at, None)))).ravel()
    basis = np.moveaxis(np.asarray(ends_outputs(at, samples)), 1, 0).reshape(3, -1).T
    ends = np.linalg.lstsq(basis, left, rcond=None)[0]
    whole = np.asarray(bounded_outputs(machine, driven_by(machine, at, jnp.asarray(ends))))
    np.testing.assert_allclose(whole, y, atol=1e-8 * np.max(np.abs(y)))
    Q, solution = (np.asarray(v) for v in span(jnp.asarray(basis)))
    np.testing.assert_allclose(solution @ (Q.T @ left), ends, rtol=1e-6)


def test_a_state_that_no_output_shows_adds_nothing():
    """Its effect is rounding; along that column something else would be taken off the errors."""
    rng = np.random.default_rng(2)
    basis = rng.standard_normal((40, 3))
    basis[:, 1] = 1e-15 * rng.standard_normal(40)
    Q, solution = (np.asarray(v) for v in span(jnp.asarray(basis)))
    shown, _ = np.linalg.qr(basis[:, [0, 2]])
    np.testing.assert_allclose(Q @ Q.T, shown @ shown.T, atol=1e-12)
    assert not solution[1].any()


@pytest.mark.slow
@pytest.mark.parametrize("moving", [("U", "D"), Machine._fields[:-1]])
def test_slopes_of_the_bounded_solution_are_those_of_forward_differentiation(moving):
    rng = np.random.default_rng(7)
    shapes = ((3, 3), (3, 2), (60, 2), (60, 2), (2, 3), (2, 2), (3,))
    machine = Machine(*(jnp.asarray(rng.standard_normal(s)) for s in shapes))
    ends = jnp.asarray(rng.standard_normal(3))
    slopes = Machine(
        *(
            jnp.asarray(rng.standard_normal((*s, 4))) if n in moving else None
            for n, s in zip(Machine._fields, shapes, strict=True)
        )
    )

    def outputs(m: Machine):
        return bounded_outputs(m, driven_by(m, resolved(m.Ad, m.C, 60), ends))

    still = Machine(*(jnp.zeros((*s, 4)) for s in shapes))
    along = slopes._replace(**{n: v for n, v in still._asdict().items() if n not in moving})
    expected = jax.vmap(
        lambda d: jax.jvp(outputs, (machine,), (d,))[1], in_axes=-1, out_axes=1
    )(along)  # fmt: skip
    at = resolved(machine.Ad, machine.C, 60)
    made = output_slopes(machine, slopes, at, driven_by(machine, at, ends))
    np.testing.assert_allclose(made, expected, rtol=1e-9, atol=1e-9 * np.max(np.abs(expected)))


def test_a_stick_is_no_instrument_of_itself():
    u, r = np.random.default_rng(1).standard_normal((2, 50))

    def flight(by):
        return Flight(dt=0.1, inputs={"lat": u}, outputs={"p": u}, instruments={"lat": by})

    assert own_instruments([flight(3.0 * u - 1.0)], ["lat"]) == ("lat",)
    # A flight in open loop beside others is none.
    assert own_instruments([flight(u), flight(r)], ["lat"]) == ()
