"""Feedback: found where a pilot holds the bank angle, not found where nobody does."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem
from heli_jax.identification.validation.feedback import feedback, feedback_notes, feedback_of
from tests.identification.test_equation_error import ROLL, Params

DT, LATE = 0.02, 5


def record(seed, gain, kind="steps", n=1000, gust=1.0):
    """A roll machine in gusts, whose stick follows the bank angle of 0.1 s ago."""
    rng = np.random.default_rng(seed)
    steps = 0.1 * np.repeat(rng.uniform(-1.0, 1.0, n // 20), 20)
    smooth = 0.1 * scipy.signal.lfilter(*scipy.signal.butter(2, 0.1), rng.standard_normal(n))
    test = steps if kind == "steps" else smooth
    phi, p, w = np.zeros(n), np.zeros(n), 0.0
    da = np.zeros(n)
    for k in range(n):
        da[k] = test[k] - gain * phi[max(k - LATE, 0)]
        if k + 1 < n:
            p[k + 1] = p[k] + DT * (-4.0 * p[k] + 25.0 * da[k] + w)
            phi[k + 1] = phi[k] + DT * p[k]
        w += -DT / 0.5 * w + gust * np.sqrt(2 * DT / 0.5) * rng.standard_normal()
    # As a potentiometer reads it.
    da = da + 2e-4 * rng.standard_normal(n)
    outputs = {"p": p + 0.01 * rng.standard_normal(n), "phi": phi + 0.005 * rng.standard_normal(n)}
    return Flight(dt=DT, inputs={"da": da}, outputs=outputs)


@pytest.mark.parametrize("kind", ["steps", "smooth"])
def test_in_an_open_loop_there_are_hardly_false_alarms(kind):
    alarms = [any(f.present for f in feedback(record(s, 0.0, kind))) for s in range(50)]
    assert sum(alarms) <= 2


def test_a_pilot_who_holds_the_bank_angle_is_found():
    found = [feedback(record(s, 0.3)) for s in range(10)]
    assert sum(any(f.present for f in one) for one in found) >= 9
    (one,) = found[0]
    # He takes the stick against the motion, no sooner than he sees it.
    assert one.correlation < 0
    assert one.lag[1] >= LATE * DT
    assert one.input == "da"


def test_steps_without_any_other_motion_are_no_feedback():
    flight = record(0, 0.0)
    held = 0.1 * np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, 50), 20)
    assert not any(f.present for f in feedback(replace(flight, inputs={"da": held})))
    short = Flight(dt=DT, inputs={"da": held[:100]}, outputs={"p": flight.outputs["p"][:100]})
    assert feedback(short) == ()


def test_missing_samples_and_a_fast_log():
    flight = record(0, 0.3, n=1500)
    p = flight.outputs["p"].copy()
    p[200:240] = np.nan
    assert any(f.present for f in feedback(replace(flight, outputs={"p": p})))
    # The same record, logged eight times as fast.
    fast = Flight(
        dt=DT / 8,
        inputs={n: np.repeat(u, 8) for n, u in flight.inputs.items()},
        outputs={n: np.repeat(y, 8) for n, y in flight.outputs.items()},
    )
    assert any(f.present for f in feedback(fast))


def test_what_it_does_is_said_unless_the_noise_model_is_right():
    flight = replace(record(0, 0.3), name="gusty")
    problem = Problem(
        ROLL, Params(-4.0, 25.0, 0.0), [flight], {"Lp": Free(-3.0), "Lda": Free(20.0)}
    )
    found = feedback_of(problem)
    (said,) = feedback_notes(problem, found, white=False)
    for words in ("The loop is closed: da follows", "gusty", "biased", "filter-error"):
        assert words in said
    opened = tuple(f._replace(p_value=0.5) for f in found)
    assert feedback_notes(problem, opened) == []
    # Filter error asks for nothing but whiteness.
    from heli_jax.dynamics.disturbance import with_disturbance
    from heli_jax.naming import asdict

    axes = replace_axes(ROLL)
    model = with_disturbance(axes, "roll")
    params = model.Params(**asdict(Params(-4.0, 25.0, 0.0)))
    filtered = Problem(model, params, [flight], {"Lp": Free(-3.0)}, method="filter-error")
    assert feedback_notes(filtered, found, white=True) == []
    assert "disturbances or dynamics are missing" in feedback_notes(filtered, found, False)[0]
    assert feedback_notes(filtered, found)


def replace_axes(model):
    from heli_jax.dynamics.model import Axis

    return replace(model, axes=(Axis("roll", rate="p", angle="phi", stick="da"),))
