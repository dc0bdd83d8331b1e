"""What responses of flights ask of their records."""

import numpy as np
import pytest

from heli_jax import Flight
from heli_jax.analysis.flight_responses import flight_responses


def test_a_flight_that_is_too_short_for_any_window_is_refused_by_its_own_length():
    t = np.arange(24) / 25.0
    flight = Flight(dt=0.04, inputs={"u": np.sin(9.0 * t)}, outputs={"y": np.cos(9.0 * t)})
    with pytest.raises(ValueError, match=r"the longest flight is 0.92 s, too short .* than 1 s"):
        flight_responses([flight])
