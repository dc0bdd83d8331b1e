"""Outliers of the residual, against least squares by SciPy without them."""

import numpy as np
import pytest
import scipy.optimize

from heli_jax import Flight, Free, Nuisance, Problem, fit

from .lag import LAG, Params, response

DT, LP, LD, NOISE = 0.02, -4.0, 30.0, 0.05


def flown(seed, share):
    """Return the stick, p with noise, and a mask of samples that drop to zero."""
    rng = np.random.default_rng(seed)
    d = np.repeat(rng.uniform(-0.5, 0.5, 80), 25)
    p = response(LP, LD, d, DT) + NOISE * rng.standard_normal(d.size)
    gone = rng.uniform(size=d.size) < share
    return d, np.where(gone, 0.0, p), gone


def fitted(d, p):
    flight = Flight(dt=DT, inputs={"d": d}, outputs={"p": p}, hold={"d": "zero-order"})
    free = {"Lp": Free(-3.0), "Ld": Free(20.0)}
    return fit(Problem(LAG, Params(-3.0, 20.0), [flight], free, Nuisance(False, False)))


def test_few_dropouts_are_found_with_their_effect():
    d, p, gone = flown(0, 0.008)
    result = fitted(d, p)
    found = next(f for f in result.findings if f.code == "quality.outliers")
    # Some dropouts happen near zero, where they do no harm.
    assert 0.6 * gone.sum() < found.value <= gone.sum()
    clean = scipy.optimize.least_squares(
        lambda z: (p - response(*z, d, DT))[~gone], [-3.0, 20.0], x_scale=[1.0, 10.0]
    ).x
    for name, value in zip(("Lp", "Ld"), clean, strict=True):
        e = result.estimates[name]
        assert e.value - found.shifts[name] == pytest.approx(value, abs=0.35 * e.sd)
    # The misfit counts only where it moves an estimate out of its interval.
    far = any(abs(found.shifts[n]) > 1.96 * result.estimates[n].sd for n in found.shifts)
    assert (found.severity, result.exit_code) == (("doubt", 3) if far else ("note", 0))


@pytest.mark.parametrize("seed", range(4))
def test_noise_alone_has_no_outliers(seed):
    d, p, _ = flown(seed, 0.0)
    assert "quality.outliers" not in [f.code for f in fitted(d, p).findings]
