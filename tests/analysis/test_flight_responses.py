"""Requirements of flight responses on their records."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight
from heli_jax.analysis.flight_responses import Settings, flight_responses


def test_a_flight_that_is_too_short_for_any_window_is_refused_by_its_own_length():
    t = np.arange(24) / 25.0
    flight = Flight(dt=0.04, inputs={"u": np.sin(9.0 * t)}, outputs={"y": np.cos(9.0 * t)})
    with pytest.raises(ValueError, match=r"the longest flight is 0.96 s, too short .* than 1 s"):
        flight_responses([flight])


def test_coherence_is_that_of_the_flights_in_which_a_stick_moves():
    """Test sweeps of one stick at a time.

    With the noise of all flights against one sweep, a coherence of 0.87 became 0.65.
    """
    rng, t = np.random.default_rng(0), 0.02 * np.arange(3000)
    sweep, rest = scipy.signal.chirp(t, 0.2, t[-1], 4.0, "linear", -90), np.zeros(t.size)
    flights = []
    for moved in ("lat", "lon", "ped", "col"):
        inputs = {n: sweep if n == moved else rest for n in ("lat", "lon", "ped", "col")}
        y = scipy.signal.lfilter([0.2], [1.0, -0.9], inputs["lat"] + inputs["lon"])
        y = y + 0.8 * rng.standard_normal(t.size)
        flights.append(Flight(dt=0.02, inputs=inputs, outputs={"p": y}))
    alone = flight_responses(flights[:1], Settings(band=(0.5, 3.0))).outputs["p"]
    together = flight_responses(flights, Settings(band=(0.5, 3.0))).outputs["p"]
    found = np.mean(together.pairs["lat"].coherence)
    assert found == pytest.approx(np.mean(alone.pairs["lat"].coherence), abs=0.05)
    assert 0.5 < found < 0.9
    # The pedals have no effect, so the coherence is that of chance in one flight.
    assert np.mean(together.pairs["ped"].coherence) < 0.2
