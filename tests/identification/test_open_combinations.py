"""A product whose interval reaches past the factor of ten is not determined."""

import math

import numpy as np
import pytest

from heli_jax.identification.identifiability.combinations import combinations
from heli_jax.identification.identifiability.verdict import Unknown

UNKNOWNS = tuple(
    Unknown(name, value, True, 1.0, 0.0) for name, value in (("Ixx", 0.05), ("a", 6.0))
)
# Both may grow by the same factor.
NULL = [np.array([1.0, 1.0]) / np.sqrt(2.0)]


def of_ratio(sd):
    """Covariance of log a and log Ixx in which log(a / Ixx) has the sd."""
    across = np.array([1.0, -1.0])
    return np.outer(across, across) * sd**2 / 4.0


def test_a_product_that_is_determined_keeps_its_interval():
    (ratio,) = combinations(NULL, of_ratio(0.1), UNKNOWNS)
    assert ratio.name == "a/Ixx"
    assert ratio.upper95 / ratio.value == pytest.approx(math.exp(0.1959964), rel=1e-5)


@pytest.mark.parametrize("sd", [1.2, 50.0, 400.0])
def test_a_product_from_nothing_to_anything_is_not_determined(sd):
    # From 1.18 on 1.96 sd are more than the logarithm of ten.
    assert combinations(NULL, of_ratio(sd), UNKNOWNS) == ()
