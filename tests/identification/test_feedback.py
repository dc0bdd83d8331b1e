"""Feedback: found if a pilot holds the bank angle, and only then."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, linear_model
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.model import Axis
from heli_jax.identification.diagnostics.loop import inputs_follow_response
from heli_jax.identification.validation.follows_response import feedback, feedback_of
from heli_jax.naming import asdict
from tests.identification.lag import LAG
from tests.identification.lag import Params as LagParams
from tests.identification.test_equation_error import ROLL, Params

DT, LATE = 0.02, 5


def record(seed, gain, kind="steps", n=1000, gust=1.0):
    """Return a roll in gusts, whose stick follows the bank angle of 0.1 s ago."""
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
    # As read by a potentiometer.
    da = da + 2e-4 * rng.standard_normal(n)
    outputs = {"p": p + 0.01 * rng.standard_normal(n), "phi": phi + 0.005 * rng.standard_normal(n)}
    return Flight(dt=DT, inputs={"da": da}, outputs=outputs)


@pytest.mark.parametrize("kind", ["steps", "smooth"])
def test_in_an_open_loop_there_are_hardly_false_alarms(kind):
    alarms = [any(f.present for f in feedback(record(s, 0.0, kind))) for s in range(20)]
    assert sum(alarms) <= 1


def test_a_pilot_who_holds_the_bank_angle_is_found():
    found = [feedback(record(s, 0.3)) for s in range(5)]
    assert sum(any(f.present for f in one) for one in found) >= 4
    (one,) = found[0]
    # He moves the stick against the motion, but not before he sees it.
    assert one.correlation < 0
    assert one.lag[1] >= LATE * DT
    assert one.input == "da"


def seen(seed, gain, noise, frequency, machine, rate=100.0):
    """Return a vehicle in gusts whose stick follows the response of 0.25 s ago.

    The pilot's view is independent of the log's sensor. It is a minute at 500 Hz, then logged.
    `machine`: damping [1/s], effect of the stick, and its lag [s].
    """
    rng, h, n, (damping, effect, lag) = np.random.default_rng(seed), 2e-3, 30_000, machine
    own = scipy.signal.lfilter(*scipy.signal.butter(2, 2 * frequency * h), rng.standard_normal(n))
    own *= (0.005 if gain else 0.1) / own.std()
    gust = 0.4 * np.sqrt(2 * h / 1.5) * rng.standard_normal(n)
    w, u, x, g = np.zeros(n), np.zeros(n), 0.0, 0.0
    for k in range(n - 1):
        u[k] = own[k] + gain * w[max(k - 125, 0)]
        x += h * (u[k] - x) / lag
        g += -h / 1.5 * g + gust[k]
        w[k + 1] = w[k] + h * (-damping * w[k] + effect * x + g)
    every = round(1 / (rate * h))
    measured = w[::every] + noise * rng.standard_normal(w[::every].size)
    return Flight(dt=1 / rate, inputs={"u": u[::every]}, outputs={"w": measured})


def test_slow_feedback_shows_through_a_noisy_sensor():
    found = [feedback(seen(s, 0.15, 0.7, 1.0, (0.7, -14.0, 0.1))) for s in range(4)]
    assert sum(one[0].present for one in found) >= 3


def test_a_quick_stick_before_a_quiet_sensor_is_no_feedback():
    # The stick moves the vehicle within a sample, and continues from there.
    records = [seen(s, 0.0, 1e-4, 8.0, (5.0, 5.0, 0.02), 50.0) for s in range(4)]
    assert sum(feedback(record)[0].present for record in records) <= 1


def logged_late(seed, samples, n=2000):
    """Return a stick that is independent of the response, logged late."""
    flight = record(seed, 0.0, n=n, gust=0.1)
    poles, u = np.exp(-20.0 * DT), np.random.default_rng(seed).standard_normal(n + 200)
    for _ in range(4):
        u = scipy.signal.lfilter([1.0 - poles], [1.0, -poles], u)
    u = 0.05 * u[200:] / u[200:].std()
    p = scipy.signal.lfilter([0.0, 25.0 * DT], [1.0, 4.0 * DT - 1.0], u)
    phi = scipy.signal.lfilter([0.0, DT], [1.0, -1.0], p)
    # The other stick's motion is removed with it; gusts and noise remain.
    other = scipy.signal.lfilter([0.0, 25.0 * DT], [1.0, 4.0 * DT - 1.0], flight.inputs["da"])
    turned = scipy.signal.lfilter([0.0, DT], [1.0, -1.0], other)
    outputs = {
        "p": flight.outputs["p"] - other + p,
        "phi": flight.outputs["phi"] - turned + phi,
    }
    late = np.concatenate([np.full(samples, u[0]), u[: n - samples]])
    return Flight(dt=DT, inputs={"da": late}, outputs=outputs)


def test_a_stick_that_is_logged_late_is_taken_when_it_acted():
    late = [logged_late(s, 3) for s in range(2)]
    # As logged it follows its own effect.
    assert sum(any(f.present for f in feedback(flight)) for flight in late) == 2
    # 0.06 s plus a margin, as for the interval of an estimate.
    for earlier in (0.06, 0.063):
        found = [feedback(flight, 1, {"da": earlier}) for flight in late]
        assert not any(f.present for one in found for f in one)
    assert found[0][0].earlier == pytest.approx(0.08)


LATE_ROLL = """
name: roll
states: {p: rad/s, phi: rad}
inputs: {da: rad}
outputs: {p: rad/s, phi: rad}
parameters:
  Lp: {value: -4, unit: 1/s}
  Lda: {value: 25, unit: 1/s^2}
  tau: {value: 0, unit: s}
A: {p: {p: Lp}, phi: {p: 1}}
B: {p: {da: Lda}}
delays: {da: tau}
"""


def test_the_delay_that_a_fit_found_is_used(tmp_path):
    (tmp_path / "roll.yaml").write_text(LATE_ROLL)
    model = linear_model(tmp_path / "roll.yaml").model
    free = {"Lp": Free(-3.0), "Lda": Free(20.0), "tau": Free(0.0)}
    problem = Problem(model, model.Params(-4.0, 25.0, 0.0), [logged_late(0, 3)], free)
    (before,) = feedback_of(problem)
    assert before.present
    assert not before.delay_known
    [said] = told(problem, [before], fitted=False)
    assert (said.code, said.severity, said.subjects) == ("loop.feedback", "doubt", ("da",))
    (after,) = feedback_of(problem, {"tau": (-0.0605, 0.001), "time_shift": (0.0, None)})
    assert (after.present, after.delay_known) == (False, True)
    assert [f.severity for f in told(problem, [after], fitted=False)] == ["ok"]
    # The delay of all inputs is added; a delay that may be zero changes nothing.
    (both,) = feedback_of(problem, {"tau": (-0.02, 0.001), "time_shift": (-0.0405, 0.001)})
    assert both.earlier == pytest.approx(0.08)
    (none,) = feedback_of(problem, {"tau": (-0.02, 0.02)})
    assert (none.present, none.delay_known, none.earlier) == (True, True, 0.0)
    fixed = {n: f for n, f in free.items() if n != "tau"}
    (held,) = feedback_of(replace(problem, vehicle=model.Params(-4.0, 25.0, -0.06), free=fixed))
    assert (held.present, held.delay_known) == (False, False)


def test_steps_without_any_other_motion_are_no_feedback():
    flight = record(0, 0.0)
    held = 0.1 * np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, 50), 20)
    assert not any(f.present for f in feedback(replace(flight, inputs={"da": held})))
    short = Flight(dt=DT, inputs={"da": held[:100]}, outputs={"p": flight.outputs["p"][:100]})
    assert feedback(short) == ()


def test_programmed_doublets_that_a_filter_rounded_are_no_feedback():
    # A command shaped as by autopilots: it has no jumps and settles slowly. There is no feedback
    # and no measurement noise.
    pattern = np.repeat([0.0, 0.3, -0.3, 0.0], [100, 40, 40, 170])
    keep = np.exp(-DT / 0.08)
    u = scipy.signal.lfilter([1.0 - keep], [1.0, -keep], np.tile(pattern, 12))
    phi, p, v = np.zeros(u.size), np.zeros(u.size), 0.0
    for k in range(u.size - 1):
        v += DT * (-11.3 * v + 49.0 * (u[k] - phi[k]))
        phi[k + 1], p[k + 1] = phi[k] + DT * v, v
    outputs = {"p": p, "phi": phi}
    assert not any(f.present for f in feedback(Flight(dt=DT, inputs={"da": u}, outputs=outputs)))


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
    (said,) = told(problem, found, white=False)
    assert (said.severity, said.value, said.distrusts) == ("doubt", found[0].p_value, ("Lp",))
    (said,) = told(problem, found, white=True)
    assert (said.severity, said.distrusts) == ("note", ())
    opened = tuple(f._replace(p_value=0.5) for f in found)
    assert [f.severity for f in told(problem, opened, white=True)] == ["ok"]
    # Filter error only needs whiteness.
    axes = replace(ROLL, axes=(Axis("roll", rate="p", angle="phi", stick="da"),))
    model = with_disturbance(axes, "roll")
    params = model.Params(**asdict(Params(-4.0, 25.0, 0.0)))
    filtered = Problem(model, params, [flight], {"Lp": Free(-3.0)}, method="filter-error")
    assert told(filtered, found, white=True) == []
    assert len(told(filtered, found, white=False)) == 1
    assert told(filtered, found, fitted=False)


def told(problem, found, *, white=False, fitted=True):
    """Return a converged fit's findings on inputs that follow the response."""
    return list(
        inputs_follow_response(
            SimpleNamespace(
                problem=problem,
                feedback=found,
                estimates={"Lp": None} if fitted else {},
                fitted=fitted,
                at_optimum=fitted,
                white=white,
                independent=white,
                params=problem.start_params(),
            )
        )
    )


def test_a_record_of_less_than_a_block_tells_nothing():
    times = 1e-7 * np.arange(6000)
    flight = Flight(1e-7, {"u": np.sin(1e4 * times)}, {"p": np.cos(1e4 * times)})
    assert feedback(flight) == ()


def shared_line(loop, shared):
    """Return a roll by a chirp, with a rotor's line at 24 Hz in the rate.

    Optionally the line is also in the stick, or there is a pilot.
    """
    rng, dt, n = np.random.default_rng(4), 0.01, 4000
    t = np.arange(n) * dt
    wander = scipy.signal.lfilter([0.02], [1, -0.98], rng.standard_normal(n))
    turned = np.cumsum(48 * np.pi * (1 + 0.01 * wander)) * dt
    gust = scipy.signal.lfilter([0.01], [1, -0.97], rng.standard_normal(n))
    stick, rate = 0.4 * np.sin(0.5 * t + 0.25 * t**2), np.zeros(n)
    for k in range(1, n):
        stick[k] -= loop * rate[k - 1]
        rate[k] = 0.9 * rate[k - 1] + 0.2 * stick[k - 1] + gust[k] * bool(loop)
    rate = rate + 0.01 * rng.standard_normal(n) + 0.2 * np.sin(turned)
    stick = stick + shared * np.sin(turned + 1) + 1e-4 * rng.standard_normal(n)
    return Flight(dt=dt, inputs={"lat": stick}, outputs={"p": rate})


@pytest.mark.parametrize(("loop", "shared"), [(0.0, 0.02), (0.0, 0.1), (0.05, 0.0)])
def test_a_line_in_stick_and_gyro_is_no_feedback(loop, shared):
    (found,) = feedback(shared_line(loop, shared))
    assert found.present == bool(loop)


@pytest.mark.parametrize("gust", [0.0, 0.1])
def test_an_unstable_vehicle_is_held_whatever_a_test_of_its_inputs_says(gust):
    rng, n = np.random.default_rng(2), 500
    test, grow = 0.3 * np.repeat(rng.choice([-1.0, 1.0], n // 10), 10), np.exp(0.4 * DT)
    p, d, w = np.zeros(n), np.zeros(n), 0.0
    for k in range(n):
        d[k] = test[k] - 0.1 * p[k]
        if k + 1 < n:
            p[k + 1] = grow * p[k] + (grow - 1.0) / 0.4 * (20.0 * d[k] + w)
        part = np.exp(-DT / 0.5)
        w = part * w + gust * np.sqrt(1.0 - part**2) * rng.standard_normal()
    measured = p + 0.003 * rng.standard_normal(n)
    flight = Flight(dt=DT, inputs={"d": d}, outputs={"p": measured})
    free = {"Lp": Free(0.3), "Ld": Free(15.0)}
    found = fit(Problem(LAG, LagParams(0.3, 15.0), [flight], free, method="output-error"))
    told = [
        f
        for f in found.findings
        if f.code in ("loop.feedback", "loop.held") and f.severity == "doubt"
    ]
    assert (len(told), found.exit_code) == ((1, 3) if gust else (0, 0))
    assert not told or told[0].value is None
    assert set(found.untrusted) == ({"Lp", "Ld"} if gust else set())
