"""Model selection prefers the model that made the record."""

import numpy as np
import pytest

from heli_jax.identification.select import Candidate, _test


def test_no_unknown_more_is_no_test():
    one = Candidate("small", "converged", -10.0, 4, 28.0, 30.0, True, {})
    assert _test(one, one._replace(name="large", log_likelihood=-8.0)).degrees == 0
    test = _test(one, one._replace(name="large", log_likelihood=-8.0, unknowns=6))
    # Chi-squared with two degrees of freedom: exp(-ratio / 2).
    assert test.p_value == pytest.approx(np.exp(-2.0), rel=1e-12)
