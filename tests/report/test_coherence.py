"""Coherence is asked for where the model expects it, with the other inputs taken out."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, models, naming
from heli_jax.analysis.operating_point import EVERYWHERE
from heli_jax.analysis.spectra import partial_coherence
from heli_jax.identification.result import Signals
from heli_jax.linear_models.read import linear_model
from heli_jax.report import card
from heli_jax.report.frequency import _spectra, coherences, linear_matrices
from tests.identification.bench import BENCH, vehicle


def by_scipy(inputs, y, j, length, dt):
    """Partial coherence of input j from the inverse of the matrix of SciPy's cross-spectra."""
    signals = [*inputs, y]
    how = {"fs": 1 / dt, "window": np.hanning(length), "noverlap": length // 2}
    G = np.array([[scipy.signal.csd(a, b, nperseg=length, detrend="linear", **how)[1]
                   for b in signals] for a in signals])  # fmt: skip
    P = np.linalg.inv(np.moveaxis(G, -1, 0))
    return (np.abs(P[:, j, -1]) ** 2 / np.abs(P[:, j, j] * P[:, -1, -1]))[1:-1]


def coloured(rng, n):
    return scipy.signal.lfilter([1.0], [1.0, -0.7], rng.standard_normal(n))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_partial_coherence_is_that_of_scipys_spectra(count):
    rng, n, dt = np.random.default_rng(5), 6000, 0.02
    common = coloured(rng, n)  # the inputs move together, as sticks of one pilot
    inputs = {f"u{k}": coloured(rng, n) + 0.8 * common for k in range(count)}
    y = sum(scipy.signal.lfilter([0.0, 0.3 + k], [1.0, -0.9], u) for k, u in
            enumerate(inputs.values())) + 3.0 * rng.standard_normal(n)  # fmt: skip
    s = Signals("f", False, np.arange(n) * dt, inputs, {"y": y}, {"y": y})
    found, _ = _spectra(s, list(inputs), "y", dt, 1.0)
    length = 2 * (found.omega.size + 1)
    for j in range(count):
        others = np.delete(found.X[..., :count], j, axis=2)
        ours = partial_coherence(others, found.X[..., j], found.X[..., count])
        np.testing.assert_allclose(ours, by_scipy(inputs.values(), y, j, length, dt), rtol=1e-8)


@pytest.fixture(scope="module")
def flown():
    """A noise-free flight of a helicopter's rates, all sticks moving: problem, fit and signals."""
    linear, dt, n = linear_model("attitude"), 0.04, 5000
    params, rng = linear.vehicle().params, np.random.default_rng(7)
    sticks = np.repeat(rng.uniform(-0.1, 0.1, (n // 10, 3)), 10, axis=0)
    A, B, C, D = linear_matrices(linear.model, params, EVERYWHERE)
    exact = scipy.signal.cont2discrete((A, B, C, D), dt)
    _, rates, _ = scipy.signal.dlsim(exact, sticks)
    u = dict(zip(naming.names(linear.model.Inputs), sticks.T, strict=True))
    y = dict(zip(naming.names(linear.model.Outputs), rates.T, strict=True))
    flight = Flight(dt=dt, inputs=u, outputs=y)
    problem = SimpleNamespace(model=linear.model, training=(flight,), flights=(flight,))
    return problem, params, Signals("flight 1", False, dt * np.arange(n), u, y, y)


def gates(flown, **changed):
    problem, params, signals = flown
    fit = SimpleNamespace(params=params, signals=(signals._replace(**changed),), nuisance={})
    return {g.of.removesuffix(", flight 1"): g for g in card._of_excitation(problem, fit)}


def test_a_noise_free_flight_of_the_exact_model_fails_no_gate(flown):
    found = gates(flown)
    assert len(found) == 9
    assert card.failed(tuple(found.values())) == ()
    # And it is asked of those that fly the axis.
    asked = {of for of, gate in found.items() if gate.passed is not None}
    assert {"lat to p", "lon to q", "ped to r"} <= asked
    assert "ped to q" not in asked
    assert all(found[of].what == "partial coherence" for of in asked)


def test_what_should_respond_and_does_not_fails(flown):
    _, _, signals = flown
    rng = np.random.default_rng(1)
    dead = {**signals.measured, "r": 0.1 * rng.standard_normal(signals.times.size)}
    found = gates(flown, measured=dead)
    assert "ped to r" in {of for of, g in found.items() if g.passed is False}
    assert found["ped to r"].value < 0.4
    # The same where the log's sticks are of another flight.
    other = {n: np.roll(u, u.size // 2) for n, u in signals.inputs.items()}
    shown = {n: np.roll(y, y.size // 2) for n, y in signals.simulated.items()}
    found = gates(flown, inputs=other, simulated=shown)
    assert found["lon to q"].passed is False


@pytest.mark.parametrize(
    "change",
    [
        {"measured": {"roll": np.r_[np.nan, np.zeros(999)]}},
        {"simulated": {"roll": np.full(1000, np.inf)}},
        {"inputs": {"x_roll": np.ones(1000)}},
    ],
)
def test_there_may_be_none(change):
    t = np.arange(1000) * 0.05
    s = Signals("f", False, t, {"x_roll": np.sin(t)}, {"roll": np.cos(t)}, {"roll": np.cos(t)})
    fit = SimpleNamespace(nuisance={})
    model, params = models.roll_on_stand, vehicle(BENCH)
    [found] = coherences(model, params, EVERYWHERE, s._replace(**change), fit).values()
    assert isinstance(found, str)
