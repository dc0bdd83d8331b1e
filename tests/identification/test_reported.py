"""Findings on autocorrelated residuals use the reported intervals."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, models
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.identifiability.analysis import Around, analyse
from heli_jax.identification.identifiability.equivalents import combinations
from heli_jax.identification.identifiability.verdict import FACTOR, Z95, Unknown
from heli_jax.identification.uncertainty.autocorrelated_residuals import residual_curvature
from tests.identification.bench import BENCH, response, steps, vehicle

N, DT = 600, 0.02


@pytest.fixture(scope="module")
def found():
    """Return 12 s of the bench with a slow oscillation larger than its response."""
    rng = np.random.default_rng(0)
    u = steps(rng, N, DT, 3e-6)
    root = 0.995 * np.exp(0.04j)
    slow = np.poly([root, root.conj()]).real
    noise = scipy.signal.lfilter([1.0], slow, rng.standard_normal(N + 2000))[2000:]
    y = response(BENCH, u, DT, True) + 0.3 * noise / noise.std()
    y += 2e-3 * rng.standard_normal(N)
    free = {"Ixx": Free(0.03), "If": Free(2e-4), "kappa": Free(3.0)}
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    return fit(Problem(models.roll_on_stand, vehicle(BENCH), [flight], free))


def test_the_factor_of_ten_rule_sees_the_interval_that_is_reported(found):
    assert found.coloured
    by_white = np.sqrt(found.verdict.covariance[0, 0])
    assert np.exp(Z95 * by_white) < FACTOR
    assert found.status == "not-identifiable"
    assert "Ixx" in found.verdict.undetermined
    assert found.estimates["Ixx"].sd is None
    assert found.estimates["Ixx"].lower95 is None
    # No determined parameter has an interval that breaks the rule.
    for e in found.estimates.values():
        if e.lower95 is not None:
            assert e.upper95 / e.value < FACTOR
            assert e.value / e.lower95 < FACTOR
    # Their product is known, and its interval allows for the residuals too.
    assert found.verdict.combinations


def test_reported_intervals_enter_the_verdict():
    unknowns = tuple(Unknown(n, 1.0, True, 1.0, 0.0) for n in ("p", "q"))
    limit = np.log(FACTOR) / Z95
    sensitivity = np.diag([10.0, 10.0])
    assert analyse(sensitivity, unknowns).identifiable
    inside, outside = np.diag([0.01, 0.9 * limit**2]), np.diag([0.01, 1.1 * limit**2])
    assert analyse(sensitivity, unknowns, around=Around(reported=inside)).identifiable
    wide = analyse(sensitivity, unknowns, around=Around(reported=outside))
    assert not wide.identifiable
    assert wide.undetermined == ("q",)
    # A parameter that may be zero has no factor.
    scaled = (unknowns[0], unknowns[1]._replace(logarithmic=False))
    assert analyse(sensitivity, scaled, around=Around(reported=outside)).identifiable


def test_the_residuals_part_of_the_hessian_is_that_of_finite_differences(found):
    """Return second differences of r'r/2, which do not use J."""
    at = found.reached

    def cost(i, j, a, b):
        z = at.z.at[i].add(a).at[j].add(b)
        return 0.5 * float(
            np.sum(np.square(residual_and_jacobian(at.layout, at.data, at.noise, z).r))
        )

    h = 2e-3
    J = np.asarray(residual_and_jacobian(at.layout, at.data, at.noise, at.z).J)
    hessian = J.T @ J + residual_curvature(at, J)
    scale = np.linalg.norm(J, axis=0)
    for i, j in ((0, 0), (0, 2), (1, 2), (2, 4)):
        corners = [a * b * cost(i, j, a * h, b * h) for a in (1, -1) for b in (1, -1)]
        wanted = sum(corners) / (4.0 * h**2)
        error = (hessian[i, j] - wanted) / (scale[i] * scale[j])
        assert abs(error) < 1e-3
    assert np.max(np.abs(hessian - J.T @ J) / np.outer(scale, scale)) > 0.05


@pytest.mark.parametrize(("sd", "determined"), [(0.1, True), (1.2, False), (400.0, False)])
def test_a_product_from_nothing_to_anything_is_not_determined(sd, determined):
    # Both may grow by the same factor; above 1.18, 1.96 sd exceed the logarithm of ten.
    unknowns = tuple(Unknown(n, v, True, 1.0, 0.0) for n, v in (("Ixx", 0.05), ("a", 6.0)))
    null = np.array([1.0, 1.0]) / np.sqrt(2.0)
    across = np.array([1.0, -1.0])
    found = combinations([null], 0.25 * sd**2 * np.outer(across, across), unknowns)
    assert [c.name for c in found] == determined * ["a/Ixx"]
    for c in found:
        assert c.upper95 / c.value == pytest.approx(np.exp(Z95 * sd), rel=1e-5)
