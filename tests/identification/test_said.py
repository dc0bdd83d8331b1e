"""Sentences of a fit agree with its numbers: none on unknowns that are not determined."""

from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import pytest

from heli_jax import Flight, Free, Nuisance, Prior, Problem, fit
from heli_jax.identification.identifiability.analysis import Around, analyse
from heli_jax.identification.identifiability.verdict import Unknown
from heli_jax.naming import Scalar
from heli_jax.simulation.inputs import random_steps
from tests.identification.lag import LAG, Params, response

N, DT = 600, 0.02


def of(found, code):
    return [f for f in found.findings if f.code == code]


class Outputs(NamedTuple):
    p: Annotated[Scalar, "rad/s", "rate"]
    again: Annotated[Scalar, "rad/s", "the same by another sensor"]


MODEL = replace(LAG, output=lambda p, s, u: Outputs(p=s.p, again=s.p), Outputs=Outputs)


def record(seed: int, shared: float, own: float) -> Flight:
    """Return two sensors of one rate, with common noise and separate noise."""
    rng = np.random.default_rng(seed)
    u = random_steps(N, DT, rng, (0.2, 1.0))
    y = response(-2.0, 3.0, u, DT) + shared * rng.standard_normal(N)
    both = {n: y + own * rng.standard_normal(N) for n in ("p", "again")}
    return Flight(dt=DT, inputs={"d": u}, outputs=both)


def problem(flight: Flight, **free: Free) -> Problem:
    return Problem(MODEL, Params(-2.0, 3.0), [flight], free, Nuisance(input_offset=False))


def test_noise_that_two_outputs_share_is_not_counted_twice():
    free = {"Lp": Free(-1.0), "Ld": Free(2.0)}
    found = fit(problem(record(0, 0.05, 1e-4), **free))
    assert found.coloured
    for e in found.estimates.values():
        assert e.sd == pytest.approx(2**0.5 * e.sd_white, rel=0.2)


def test_an_estimate_that_leaves_its_prior_is_told():
    found = fit(problem(record(1, 0.0, 0.02), Lp=Free(-2.0, prior=Prior(-3.0, 0.1)), Ld=Free(2.0)))
    [one] = of(found, "fit.prior-contradicted")
    assert (one.severity, one.subjects, found.untrusted) == ("doubt", ("Lp",), ("Lp",))
    assert one.value == pytest.approx(abs(found.estimates["Lp"].value + 3.0) / 0.1)
    assert found.estimates["Lp"].lower95 is None
    assert found.exit_code == 3
    agreed = fit(problem(record(1, 0.0, 0.02), Lp=Free(-2.0, prior=Prior(-2.1, 0.1)), Ld=Free(2.0)))
    assert not of(agreed, "fit.prior-contradicted")
    assert agreed.exit_code == 0


def test_an_effect_that_ends_with_the_other_sign_is_told():
    flight = record(1, 0.0, 0.02)
    turned = Flight(dt=DT, inputs={"d": -flight.inputs["d"]}, outputs=dict(flight.outputs))
    free = {"Lp": Free(-1.0), "Ld": Free(2.0, sign="any")}
    found = fit(problem(turned, **free))
    assert found.estimates["Ld"].value == pytest.approx(-3.0, rel=0.1)
    [one] = of(found, "signs.turned-from-start")
    assert (one.severity, one.subjects) == ("doubt", ("Ld",))
    assert not of(fit(problem(flight, **free)), one.code)
    # A start near zero does not determine a sign.
    free["Ld"] = Free(0.1, sign="any")
    assert not of(fit(problem(turned, **free)), one.code)


def unknowns(*names: str, **priors: float) -> tuple[Unknown, ...]:
    return tuple(Unknown(n, 1.0, True, 1.0, priors.get(n, 0.0)) for n in names)


def test_the_factor_of_ten_is_asked_of_the_others_too_where_one_has_no_effect():
    sensitivity = np.array([[100.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    verdict = analyse(sensitivity, unknowns("L", "B", "D"))
    assert set(verdict.undetermined) == {"B", "D"}


def test_the_reported_interval_is_asked_of_the_others_too():
    sensitivity = np.array([[100.0, 0.0, 0.0], [0.0, 50.0, 0.0]])
    reported = np.diag([1e-4, 4.0, 0.0])
    verdict = analyse(sensitivity, unknowns("L", "B", "D"), around=Around(reported=reported))
    assert set(verdict.undetermined) == {"B", "D"}


def test_who_takes_a_small_part_is_not_called_determined():
    sensitivity = np.array([[1.0, -0.02, 0.0], [0.0, 0.0, 4.0]])
    verdict = analyse(sensitivity, unknowns("a", "c", "B"))
    assert set(verdict.undetermined) == {"a", "c"}


def test_parameters_that_are_correlated_as_a_group_are_pairs():
    # Three change together along one direction, two along another, F alone.
    rng = np.random.default_rng(0)
    names = ("a", "Ixx", "Iyy", "Ir", "K", "F")
    covariance = 1e-6 * np.eye(6)
    together = np.array([1.0, 1.1, 0.9, 0.0, 0.0, 0.0])
    other = np.array([0.0, 0.0, 0.0, 1.0, -1.0, 0.0])
    for direction in (together, other):
        covariance += 1e-3 * np.outer(direction, direction)
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    # Any rotation of the rows has the same covariance.
    rotation = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    verdict = analyse(rotation @ root, unknowns(*names))
    # The reference: c_i c_j / sqrt((c_i^2 + e)(c_j^2 + e)), e = 1e-3.
    c = dict(zip(names, together + other, strict=True))
    found = {frozenset((p.first, p.second)): p.correlation for p in verdict.pairs}
    wanted = [("a", "Ixx"), ("a", "Iyy"), ("Ixx", "Iyy"), ("Ir", "K")]
    assert found.keys() == {frozenset(p) for p in wanted}
    for i, j in wanted:
        r = c[i] * c[j] / np.sqrt((c[i] ** 2 + 1e-3) * (c[j] ** 2 + 1e-3))
        assert found[frozenset((i, j))] == pytest.approx(r, rel=1e-6)


def test_what_is_determined_in_a_wide_interval_is_so_only_roughly():
    # The interval of B reaches a factor of exp(1.96 * 0.8) = 4.8 to either side.
    sensitivity = np.diag([100.0, 1.0 / 0.8])
    verdict = analyse(sensitivity, unknowns("L", "B"))
    assert verdict.identifiable
    assert verdict.roughly == ("B",)
    around = Around(reported=np.diag([0.64, 1e-4]))
    verdict = analyse(np.diag([2.5, 100.0]), unknowns("L", "B"), around=around)
    assert verdict.roughly == ("L",)
    # With either sign the interval is -0.57 to 2.57 times the value: no factor.
    first, second = unknowns("L", "B")
    verdict = analyse(sensitivity, (first, second._replace(symmetric=True)))
    assert verdict.roughly == ("B",)
    # The same holds if the value is small relative to the start, the unit of its coordinate.
    near = second._replace(symmetric=True, logarithmic=False, reference=500.0)
    for sd, zero in ((0.0009, ()), (0.0011, ("B",))):
        verdict = analyse(np.diag([100.0, 1.0 / sd]), (first, near))
        assert verdict.identifiable
        assert verdict.roughly == zero


def test_of_a_time_shift_at_its_end_is_not_said_that_it_has_no_effect():
    # The search uses a tanh, whose slope vanishes there; the record prefers a value beyond.
    [parameter] = unknowns("L")
    shift = Unknown("time_shift", 0.5, False, 1.0, 0.0, is_parameter=False, at_bound=True)
    verdict = analyse(np.array([[100.0, 0.0]]), (parameter, shift))
    assert verdict.without_effect == ("time_shift",)
