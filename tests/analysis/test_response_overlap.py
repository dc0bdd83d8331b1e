"""Parts of responses to sweeps that windows cut off."""

import numpy as np
from scipy.signal import lfilter

from heli_jax import Flight
from heli_jax.analysis.flight_responses import Settings, flight_responses

DT, SECONDS = 0.02, 120.0


def test_a_sweep_without_noise_gives_its_response_to_a_quarter_of_a_percent() -> None:
    """Test the median error: 0.13 %; with half-overlapping windows it was 1.1 %."""
    t = np.arange(0.0, SECONDS, DT)
    rate = np.log(8.0 / 0.2) / SECONDS
    u = 0.1 * np.sin(2.0 * np.pi * 0.2 * (np.exp(rate * t) - 1.0) / rate)
    b, a = [0.0, 0.085, 0.073], [1.0, -1.59, 0.648]  # a mode of 2 Hz, at this rate
    outputs = {"p": np.asarray(lfilter(b, a, u)), "w": np.zeros(t.size)}
    flight = Flight(dt=DT, inputs={"lat": u}, outputs=outputs)
    found = flight_responses([flight], Settings(band=(0.3, 6.0), window=24.0))
    z = np.exp(-1j * found.omega * DT)
    H = np.polyval(b[::-1], z) / np.polyval(a[::-1], z)
    assert np.median(np.abs(found.outputs["p"].pairs["lat"].H / H - 1.0)) < 0.0025
    # For a stick at rest the note states this and does not ask for longer windows.
    assert ("w",) in [n.subjects for n in found.notes if n.code == "responses.still"]
