"""Agreement of a model's responses with measured ones."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from heli_jax.analysis.response_agreement import _J, ResponseAgreement
from heli_jax.analysis.spectra import Windowed


def test_what_lies_above_a_sweep_has_no_part_in_J():
    """Test a right model, with a response that is noise above 4 Hz, as in records of sweeps."""
    rng, hz = np.random.default_rng(0), np.arange(1, 400) / 10.0
    H = 1.0 / (1.0 + 1j * hz)
    swept = hz < 4.0
    noise = (rng.standard_normal(hz.size) + 1j * rng.standard_normal(hz.size)) / np.sqrt(2.0)
    E = np.where(swept, 0.02 * H, 3.0) * noise
    coherence = np.where(swept, 0.95, 0.2)
    windows = cast(Windowed, SimpleNamespace(hz=hz, seconds=10.0))
    used = np.ones(hz.size, bool)
    assert _J(windows, used, (H + E, E, coherence)) < 10.0
    assert np.isnan(_J(windows, used, (H + E, E, np.full(hz.size, 0.2))))


@pytest.mark.parametrize(
    ("chi_squared", "said"), [(0.4, True), (0.773, True), (1.0, False), (1.2, True)]
)
def test_squared_errors_outside_of_their_interval_are_said_on_either_side(chi_squared, said):
    """Test that a ratio of 0.773, where 0.906 to 1.1 is expected, is reported in a sentence."""
    agreement = ResponseAgreement((), chi_squared, 0.906, 1.1, 800.0, 10.0, (), (), ())
    assert agreement.outside == said
