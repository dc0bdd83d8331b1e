"""Low-passed and decimated noise is neither a disturbance nor missing dynamics."""

import numpy as np
import pytest
import scipy.signal

from heli_jax.flights import Signal, read_flight
from heli_jax.identification.validation.metrics import in_passed_band, is_decimated, whiteness


def at_half_the_rate(noise: np.ndarray) -> np.ndarray:
    """Return a signal low-passed by SciPy: passes to 0.4 of the new rate, stops at half of it."""
    taps = scipy.signal.firwin(201, 0.225, window=("kaiser", 7.0), fs=1.0)
    return scipy.signal.lfilter(taps, 1.0, noise)[201::2]


@pytest.mark.parametrize("memory", [0.0, 0.3])
def test_noise_that_was_white_is_white_but_for_its_low_pass(memory):
    rng = np.random.default_rng(2)
    plain, in_band = 0, 0
    for _ in range(20):
        noise = at_half_the_rate(rng.standard_normal(8000))
        noise = scipy.signal.lfilter([1.0], [1.0, -memory], noise)
        noise[rng.integers(0, noise.size, 40)] = np.nan
        plain += whiteness(noise).white
        in_band += whiteness(in_passed_band(noise)).white
    # At 1 % one of a hundred white records fails; autocorrelation is still found.
    assert plain == 0
    assert in_band >= 19 if not memory else in_band == 0


@pytest.mark.parametrize(("rate", "decimated"), [(100.0, True), (200.0, False), (None, False)])
def test_a_flight_knows_that_its_log_was_faster(tmp_path, rate, decimated):
    t = np.arange(0.0, 5.0, 0.005)
    rows = [f"{a:.3f},{np.sin(a):.5f},{np.cos(a):.5f}" for a in t]
    (tmp_path / "log.csv").write_text("t,lat,p\n" + "\n".join(rows) + "\n")
    flight = read_flight(
        tmp_path / "log.csv",
        time=Signal("t", "s", "s"),
        inputs={"lat": Signal("lat", "1", "1")},
        outputs={"p": Signal("p", "rad/s", "rad/s")},
        rate=rate,
    )
    assert is_decimated(flight, "p") == decimated
