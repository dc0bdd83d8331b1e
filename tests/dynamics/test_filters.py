"""Filters of a flight controller around a model, against SciPy and closed formulas."""

import math

import numpy as np
import pytest
import scipy.signal

from heli_jax import linear_model, models, naming, simulate
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import linear_misfit
from heli_jax.dynamics.onboard.filters import cutoff, line_order, line_rate
from heli_jax.models import Filter, with_filters
from heli_jax.simulation.simulate import substeps_for

ROLL = linear_model("roll-flybarless")
PARAMS = ROLL.vehicle().params
W = 2 * math.pi * np.array([0.2, 3.0, 20.0, 40.0, 150.0])


def transfer(model, output):
    p = model.Params(**naming.asdict(PARAMS))
    A, B, C, D = (np.asarray(M) for M in jacobians(model, p))
    i = naming.names(model.Outputs).index(output)
    eye = np.eye(len(A))
    return np.array([C[i] @ np.linalg.solve(1j * w * eye - A, B[:, 0]) + D[i, 0] for w in W])


def by_filter(filters=(), delay=0.0):
    """Return the response at W of what is between p and its log."""
    model = with_filters(ROLL.model, {"p": filters}, {"p": delay})
    return transfer(model, "p") / transfer(ROLL.model, "p")


def test_low_passes_are_three_decibels_down_where_they_say():
    for filter in (Filter("pt1", 20.0), Filter("pt2", 20.0), Filter("pt3", 20.0)):
        n = int(filter.kind[-1])
        w = 2 * math.pi * 20 / math.sqrt(2 ** (1 / n) - 1)
        np.testing.assert_allclose(by_filter([filter]), (1 + 1j * W / w) ** -n, rtol=1e-9)
        np.testing.assert_allclose(abs(by_filter([filter])[2]), math.sqrt(0.5), rtol=1e-9)
    num, den = scipy.signal.butter(2, 2 * math.pi * 40, analog=True)
    _, expected = scipy.signal.freqs(num, den, W)
    np.testing.assert_allclose(by_filter([Filter("biquad", 40.0)]), expected, rtol=1e-9)


def test_low_passes_in_a_row_are_three_decibels_down_together():
    # A Bessel filter of fourth order is two of second order with different corners.
    _, poles, _ = scipy.signal.besselap(4, norm="mag")
    pairs = poles[poles.imag > 0]
    bessel = [Filter("biquad", 250 * abs(p), abs(p) / (-2 * p.real)) for p in pairs]
    assert cutoff(bessel) == pytest.approx(250, rel=2e-3)
    assert cutoff([Filter("pt2", 30.0)]) == pytest.approx(30, rel=2e-3)
    # A cascade of two is specified by its own cut-off, here corrected to two lags of 40 Hz.
    assert cutoff([Filter("pt1", 40.0)] * 2) == pytest.approx(40 * (2**0.5 - 1) ** 0.5, rel=2e-3)


def test_a_notch_takes_its_centre_and_its_width():
    w0 = 2 * math.pi * 20
    for q, attenuation in ((5.0, math.inf), (2.0, 40.0)):
        left = 10 ** (-attenuation / 20)
        num, den = [1, left * w0 / q, w0**2], [1, w0 / q, w0**2]
        _, expected = scipy.signal.freqs(num, den, W)
        notch = Filter("notch", 20.0, q, attenuation)
        np.testing.assert_allclose(by_filter([notch]), expected, rtol=1e-8, atol=1e-9)
        # The phase near zero frequency is a delay.
        np.testing.assert_allclose(-np.angle(expected[0]) / W[0], notch.delay, rtol=2e-3)


def test_a_cascade_is_the_product_and_a_delay_is_late():
    first, second = Filter("pt1", 30.0), Filter("notch", 20.0, 3.0)
    both = by_filter([first]) * by_filter([second])
    np.testing.assert_allclose(by_filter([first, second]), both, rtol=1e-8, atol=1e-9)
    for delay in (0.001, 0.003, 0.008):
        np.testing.assert_allclose(
            by_filter(delay=delay)[:3], np.exp(-1j * W[:3] * delay), atol=1e-3
        )
    assert line_order(0.003) == 2
    # Padé's [1/2] of exp(-s): the product of its two poles is 6.
    np.testing.assert_allclose(line_rate(2, 0.003), math.sqrt(6) / 0.003)


def test_the_log_is_the_filtered_motion_sample_by_sample():
    model = with_filters(ROLL.model, {"p": [Filter("biquad", 30.0)]}, {"phi": 0.02})
    assert model.linear
    assert linear_misfit(model, PARAMS) < 1e-12
    # Names and units of the added states; params are those of the model.
    assert model.Params is ROLL.model.Params
    assert naming.unit(model.State, "p_filter1_rate") == "rad/s^2"
    rng = np.random.default_rng(1)
    u = np.repeat(rng.standard_normal(12), 8)
    run = simulate(model, PARAMS, model.Inputs(lat=u), dt=0.01)
    # SciPy in steps of 0.1 ms, with the stick held.
    num, den = scipy.signal.butter(2, 2 * math.pi * 30, analog=True)
    roll = ([166.1 * 0.1398 / 0.04631], [1, 1 / 0.04631, 166.1])
    times = np.arange(u.size * 100) * 1e-4
    held = np.repeat(u, 100)
    for y, system, late in (
        (run.outputs.p, (np.polymul(roll[0], num), np.polymul(roll[1], den)), 0),
        (run.outputs.phi, (roll[0], [*roll[1], 0]), 200),
    ):
        d = scipy.signal.cont2discrete(system, 1e-4)
        fine = scipy.signal.lfilter(d[0].ravel(), d[1], held)
        expected = np.concatenate([np.zeros(late), fine])[: times.size : 100]
        np.testing.assert_allclose(y, expected, atol=2e-4 * np.max(np.abs(expected)))


def test_fixed_steps_follow_a_fast_filter():
    model = with_filters(models.roll, {"roll_rate": [Filter("pt1", 300.0)]})
    assert model.fastest == 2 * math.pi * 300
    # RK4 with four steps, which are enough without a filter, would diverge: 0.02 / 4 * 1885 > 2.8.
    assert substeps_for(0.02) == 4
    assert 0.02 / substeps_for(0.02, model.fastest) * model.fastest <= 1.4
    assert with_filters(model, {}, {"roll": 0.003}).fastest == model.fastest


@pytest.mark.parametrize(
    ("filters", "delays"),
    [
        ({"q": [Filter("pt1", 30.0)]}, {}),
        ({"p": [Filter("pt4", 30.0)]}, {}),
        ({"p": [Filter("pt1", 0.0)]}, {}),
        ({"p": [Filter("notch", 30.0)]}, {}),
        ({"p": [Filter("pt1", 30.0, 0.7)]}, {}),
        ({"p": [Filter("biquad", 30.0, -1.0)]}, {}),
        ({"p": [Filter("biquad", 30.0, None, 20.0)]}, {}),
        ({}, {"p": -0.01}),
        ({}, {"p": 4.0}),
        ({}, {"p": math.nan}),
        ({}, {"phi": 0.01}),
    ],
)
def test_what_is_no_filter_is_refused(filters, delays):
    late = models.with_delays(ROLL.model, outputs=["phi"])
    with pytest.raises(ValueError):  # noqa: PT011
        with_filters(late, filters, delays)
