"""Stuck sensors and dropouts in records of any rate."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from heli_jax.flights.flight import Flight, Source
from heli_jax.flights.signal_facts import facts_of_all
from heli_jax.identification.diagnostics.record import stuck_outputs

RNG = np.random.default_rng(0)
T = 0.005 * np.arange(6000)
STICK = np.repeat(RNG.uniform(-0.3, 0.3, 80), 75)
# A damped oscillation at 2 Hz, by SciPy.
ANSWER = scipy.signal.lsim(([20.0, 0.0], [1.0, 8.0, 160.0]), STICK, T)[1]
ANSWER = ANSWER / ANSWER.std()


def test_a_stuck_sensor_is_seen_in_steps_as_large_as_its_noise_and_dropouts_are_named():
    noisy = 20.0 * ANSWER + np.random.default_rng(3).standard_normal(T.size)

    def of(y):
        signals = {"p": (T, y), "q": (T, noisy[::-1].copy())}
        return facts_of_all(signals, frozenset({"p"}))["p"]

    for step in (0.0, 0.5, 1.0):
        y = np.round(noisy / step) * step if step else noisy
        assert of(y).stretches == ()
        assert of(y).dropouts is None
        stuck = np.where((T > 5) & (T < 9), y[1000], y)
        stuck = np.where((T > 20) & (T < 22), y[4000], stuck)
        lengths = [s.end - s.begin for s in of(stuck).stretches]
        assert lengths == pytest.approx([4.0, 2.0], abs=0.05)
    frozen = np.where((T > 5) & (T < 9), 3.0, noisy)
    assert len(of(frozen).stretches) == 1
    assert len(of(frozen).within(8.0, 12.0).stretches) == 1
    assert of(frozen).within(10.0, 12.0).stuck is None
    dropped = np.where(T % 1.0 < 0.3, 0.0, noisy)
    found = of(dropped).dropouts
    assert found.value == 0.0
    assert of(dropped).dropped == pytest.approx(0.3, abs=0.01)
    # A noise-free vehicle that repeatedly comes to rest is not a sensor failure.
    u = np.repeat(np.tile([0.0, 1.0], 10), 300)
    rests = scipy.signal.lfilter([0.05], [1.0, -0.95], u)
    assert of(np.round(rests, 5)).dropouts is None
    assert of(np.round(rests, 5)).stretches == ()


def test_dropouts_that_hold_the_last_value_are_told_by_what_they_take_together():
    noisy = ANSWER + 0.1 * np.random.default_rng(4).standard_normal(T.size)
    moves = np.random.default_rng(5).standard_normal(T.size)

    def of(begins, length):
        y = noisy.copy()
        for k in begins:
            y[k : k + length] = y[k]
        signals = {"p": (T, y), "q": (T, moves)}
        return facts_of_all(signals, frozenset({"p"}))["p"]

    # 0.3 s each, of 30 s.
    found = of(range(300, 5700, 600), 60)
    assert len(found.stretches) == 9
    flight = Flight(0.005, inputs={"u": STICK}, outputs={"p": noisy})
    source = Source("a.csv", "", facts={("p", "output"): found})
    [told] = stuck_outputs(SimpleNamespace(flights=[("one", replace(flight, source=source))]))
    assert (told.code, told.severity) == ("quality.stuck-output", "doubt")
    assert told.value == pytest.approx(9 * 0.295)
    # A second of it, and a part with only one of them.
    assert len(found.within(1.0, 9.0).stretches) == 3
    assert found.within(3.0, 6.0).stuck is None
    # Once or twice, or below 1 % of a record, it is a logger's fault.
    assert of((300, 3000), 60).stretches == ()
    assert of(range(300, 5700, 2000), 22).stretches == ()
