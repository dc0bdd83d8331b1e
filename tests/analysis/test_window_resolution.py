"""Effect of windows on the response to a sweep, and inputs that move as one."""

import numpy as np
import scipy.signal

from heli_jax import Flight
from heli_jax.analysis.flight_responses import Settings, TransferRequest, flight_responses
from heli_jax.analysis.transfer_fit import TransferFit

DT, N = 0.02, 3000


def swept() -> tuple[np.ndarray, np.ndarray]:
    """Return a sweep of 60 s, and the response 80 / (s^2 + 3 s + 40) to it held between samples."""
    t = DT * np.arange(N)
    u = 0.2 * scipy.signal.chirp(t, 0.1, t[-1], 6.0, "logarithmic", -90)
    b, a, _ = scipy.signal.cont2discrete(([80.0], [1.0, 3.0, 40.0]), DT, "zoh")
    y = scipy.signal.lfilter(np.ravel(b), a, u)
    return u, y + 1e-4 * np.random.default_rng(5).standard_normal(N)


def test_a_sweep_in_little_noise_gives_the_transfer_function_that_made_it():
    u, y = swept()
    flight = Flight(dt=DT, inputs={"lat": u}, outputs={"phi": y}, hold={"lat": "zero-order"})
    wanted = TransferRequest("lat", "phi", zeros=0, poles=2)
    settings = Settings((0.2, 6.0), 15.0, transfer_functions=(wanted,))
    [(_, found)] = flight_responses([flight], settings).fits
    assert isinstance(found, TransferFit)
    assert found.delay is not None
    # The order is right, and the windows' error does not indicate another one.
    assert found.chi_squared < 2.0
    truth = (80.0, 3.0, 40.0, 0.0)
    for one, true in zip((*found.numerator, *found.denominator, found.delay), truth, strict=True):
        assert abs(one.value - true) < 3.0 * one.sd
    assert found.delay.sd < 1e-4


def test_inputs_that_move_as_one_are_named():
    u, y = swept()
    # The standard deviation of an input at rest is rounding.
    inputs = {"lat": u, "lat2": 0.5 * u, "col": np.full_like(u, 0.1570692120656821)}
    flight = Flight(dt=DT, inputs=inputs, outputs={"phi": y})
    found = flight_responses([flight], Settings((0.2, 6.0), 15.0))
    assert not np.isfinite(found.outputs["phi"].pairs["lat"].H).any()
    as_one = [n.subjects for n in found.notes if n.code == "excitation.inputs-as-one"]
    assert as_one == [("lat", "lat2")]
