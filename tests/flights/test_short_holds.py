"""Values that a logger repeats for a moment are told from chance, and from a signal at rest."""

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from heli_jax.flights.signal_facts import facts_of_all

T = np.arange(4000) * 0.01


def motion(noise, step=0.0, cutoff=0.0):
    """A rate of 0.3 rad/s and its angle, with noise [rad/s], low-passed [Hz], in steps of a log."""
    rng = np.random.default_rng(3)
    rate = 0.3 * np.sin(3 * T) + 0.2 * np.sin(7.3 * T + 1) + noise * rng.standard_normal(T.size)
    if cutoff:
        rate = lfilter(*butter(2, cutoff, fs=100), rate)
    angle = np.cumsum(rate) * 0.01 + 0.3 * noise * rng.standard_normal(T.size)
    return [np.round(x / step) * step if step else x for x in (rate, angle)]


def held(x, count):
    rng = np.random.default_rng(4)
    x = x.copy()
    for first in np.linspace(100, 3850, count).astype(int):
        x[first : first + rng.integers(5, 16)] = x[first]
    return x


@pytest.mark.parametrize(("noise", "cutoff"), [(0.02, 0.0), (0.002, 0.0), (0.02, 15.0), (0.0, 0.0)])
def test_short_holds_are_told(noise, cutoff):
    rate, angle = motion(noise, cutoff=cutoff)
    signals = {"p": (T, held(rate, 30)), "phi": (T, angle)}
    facts = facts_of_all(signals, frozenset(signals))
    assert 15 <= len(facts["p"].stretches) <= 30
    assert not facts["phi"].stretches


@pytest.mark.parametrize("noise", [0.02, 0.002, 0.0])
@pytest.mark.parametrize("step", [0.0, 1e-4, 1.7e-3, 0.0175])
@pytest.mark.parametrize("cutoff", [0.0, 5.0])
def test_signals_that_nothing_holds_have_none(noise, step, cutoff):
    signals = {n: (T, x) for n, x in zip("pf", motion(noise, step, cutoff), strict=True)}
    assert not any(f.stretches for f in facts_of_all(signals, frozenset(signals)).values())
