"""Tischler's J of a response to which only a part of the band is excited."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from heli_jax.analysis.response_agreement import pair_agreements

HZ = np.arange(1, 400) / 20.0


def _cost(coherent: np.ndarray) -> float:
    """Of the model that made the record: its errors are the random ones."""
    w: Any = SimpleNamespace(inputs=("lat",), outputs=("p",), hz=HZ, seconds=20.0)
    coherence = np.where(coherent, 0.95, 0.1)
    noise = np.random.default_rng(1).standard_normal((2, HZ.size))
    relative = np.sqrt((1.0 - coherence) / coherence / 18.0)
    true = 10.0 / (2j * np.pi * HZ + 5.0)
    E = relative * np.abs(true) * (noise[0] + 1j * noise[1])
    shape = (HZ.size, 1, 1)
    (pair,) = pair_agreements(
        w,
        np.ones(shape, bool),
        (true + E).reshape(shape),
        E.reshape(shape),
        np.ones(shape),
        coherence.reshape(shape),
        (True,),
    )
    return pair.J


def test_lines_without_coherence_do_not_count_in_the_cost() -> None:
    assert _cost(HZ < 4.0) < 20.0
    assert np.isnan(_cost(HZ < 0.0))
