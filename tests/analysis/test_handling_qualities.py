"""Handling qualities against values by hand and other code; coverage of their intervals."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.signal

from heli_jax import linear_model, naming
from heli_jax.analysis.flight_responses import Settings, flight_responses
from heli_jax.analysis.handling_qualities import handling_qualities
from heli_jax.analysis.margins import margins
from heli_jax.analysis.response_curves import (
    integrated,
    linear_responses,
    measured_curve,
    modelled_curve,
    times,
    without_hold,
)
from heli_jax.flights import Flight

T, TAU = 0.1, np.pi / 40.0
"""Parameters of 1 / (s (T s + 1)) exp(-TAU s): at 10 rad/s the lag is 90 + 45 + 45 deg."""
OMEGA = np.geomspace(1.0, 40.0, 120)
BY_HAND = {
    "w180": 10.0,
    # At 20 rad/s the lag is 90 + atan 2 + 90 deg.
    "phase_delay": np.arctan(2.0) / 20.0,
    # The gain at 10 rad/s is 1 / sqrt(200). It is twice that (6 dB) where w^2 (1 + w^2 / 100) = 200
    # / 4.
    "gain_bandwidth": np.sqrt(50.0 * (np.sqrt(1.0 + 0.04 * 200.0 / 10.0**0.6) - 1.0)),
}


def plant(omega: np.ndarray) -> np.ndarray:
    s = 1j * omega
    return np.exp(-TAU * s) / (s * (T * s + 1.0))


def measured(H: np.ndarray, sd: float = 1e-3):
    k = np.ones(OMEGA.size)
    return measured_curve(OMEGA, H, sd * np.abs(H), 0.99 * k, 20.0)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_lag_with_an_integrator_and_a_delay_has_the_values_by_hand(sign):
    found = handling_qualities(measured(sign * plant(OMEGA)))
    assert found.sign == sign
    for name, value in BY_HAND.items():
        assert found.numbers[name].value == pytest.approx(value, rel=2e-4)
    phase = found.numbers["phase_bandwidth"].value
    assert np.arctan(T * phase) + TAU * phase == pytest.approx(0.25 * np.pi, rel=1e-4)
    # The lesser of both; the line through the phase from 10 to 20 rad/s is slightly steeper.
    assert found.numbers["bandwidth"] == found.numbers["phase_bandwidth"]
    w = np.linspace(10.0, 20.0, 400)
    slope = np.polyfit(w, -0.5 * np.pi - np.arctan(T * w) - TAU * w, 1)[0]
    assert found.numbers["phase_delay_line"].value == pytest.approx(-slope / 2.0, rel=2e-3)


def test_attitude_command_takes_the_phase_bandwidth_and_warns():
    # A lightly damped second-order lag: the phase falls before the gain.
    s = 1j * OMEGA
    H = 36.0 / (s**2 + 2.0 * 0.3 * 6.0 * s + 36.0) * np.exp(-0.1 * s)
    curve = measured(H)
    rate, command = (handling_qualities(curve, k) for k in ("rate", "attitude-command"))
    assert command.numbers["bandwidth"] == command.numbers["phase_bandwidth"]
    # Near the resonance the gain never reaches twice that at w180: a rate response has no
    # bandwidth.
    assert "bandwidth" not in rate.numbers
    assert any("gain bandwidth is indeterminate" in s for s in command.sentences)


def test_what_the_band_does_not_reach_has_no_number():
    near = OMEGA < 18.0
    coherence = np.where(near, 0.95, 0.1)
    curve = measured_curve(OMEGA, plant(OMEGA), 1e-3 * np.abs(plant(OMEGA)), coherence, 20.0)
    found = handling_qualities(curve)
    assert "bandwidth" in found.numbers
    assert "phase_delay" not in found.numbers
    assert any("2 w180 is 3.18 Hz" in s for s in found.sentences)
    assert "stays below 0.6" in measured_curve(
        OMEGA, plant(OMEGA), np.abs(plant(OMEGA)), 0.1 * coherence, 20.0
    )


@pytest.mark.parametrize("turn", [2.0, np.pi, -2.0])
def test_past_a_bin_whose_phase_leaps_nothing_is_known(turn):
    # Unwrapped through the gap, the phase from 20 rad/s may be a turn off, with a negative delay.
    i = int(np.searchsorted(OMEGA, 19.0))
    H = plant(OMEGA) * np.exp(1j * np.where(np.arange(OMEGA.size) > i, -0.6 * turn, 0.0))
    H[i] *= 4.0 * np.exp(1j * turn)
    found = handling_qualities(measured(H))
    assert found.band[1] < 19.0
    assert "phase_delay" not in found.numbers
    assert any("phase delay: not determined" in s for s in found.sentences)
    assert found.numbers["w180"].value == pytest.approx(10.0, rel=1e-3)


def test_a_loop_has_the_margins_of_its_matrices():
    A, b, c = scipy.signal.tf2ss([40.0], np.polymul([1.0, 5.0, 0.0], [1.0, 8.0]))[:3]
    theirs = margins(A[None], b[:, 0][None], c, np.zeros(1), 3.0)
    s = 1j * OMEGA
    H = 40.0 / (s * (s + 5.0) * (s + 8.0))
    found = handling_qualities(times(measured(H), 3.0), "open-loop")
    assert found.numbers["gain_margin"].value == pytest.approx(theirs.gain[0], rel=1e-3)
    assert found.numbers["phase_margin"].value == pytest.approx(theirs.phase[0], rel=1e-3)


def test_a_loop_with_an_unstable_machine_has_the_margins_of_its_sign():
    s = 1j * OMEGA
    H = 6.0 / ((s - 1.0) * (0.05 * s + 1.0)) * np.exp(-0.02 * s)
    found = handling_qualities(times(measured(-H), -1.0), "open-loop")
    # By hand: |L| = 1 at 5.684 rad/s; arg L = -180 deg at 28.69 rad/s.
    w = np.sqrt((-401.0 + np.sqrt(401.0**2 + 4.0 * 400.0 * 35.0)) / 2.0)
    lag = np.pi - np.arctan(w) + np.arctan(0.05 * w) + 0.02 * w
    assert found.sign == 1
    assert found.numbers["crossover"].value == pytest.approx(w, rel=1e-3)
    assert found.numbers["phase_margin"].value == pytest.approx(180 - np.degrees(lag), abs=0.1)
    assert found.numbers["gain_margin"].value == pytest.approx(18.45, abs=0.05)
    assert any("lower gain margin of -1" in s for s in found.sentences)


def test_of_a_model_the_derivatives_are_those_of_finite_differences():
    of_file = linear_model("roll-flybarless")
    model = of_file.model
    params = of_file.vehicle().params
    names = ("Lb", "tau_f")
    sds = {"Lb": 8.0, "tau_f": 0.002}
    values = naming.asdict(params)

    def numbers(**changes: float) -> dict:
        here = naming.replace(params, **{n: jnp.asarray(v) for n, v in changes.items()})
        of = linear_responses(model, here, names)
        root = np.diag([sds[n] for n in names])
        # Rate and attitude give the same.
        curve = integrated(modelled_curve(of, ("lat", "p"), root, (2.0, 60.0)))
        return handling_qualities(curve).numbers

    found = numbers()
    root = np.diag([sds[n] for n in names])
    attitude = modelled_curve(
        linear_responses(model, params, names), ("lat", "phi"), root, (2.0, 60.0)
    )
    by_attitude = handling_qualities(attitude).numbers
    # Without a delay the lag ends at 270 deg, and the phase at 2 w180 exists.
    assert set(found) >= {"bandwidth", "gain_bandwidth", "phase_delay", "phase_delay_line"}
    for name, number in found.items():
        assert by_attitude[name].value == pytest.approx(number.value, rel=1e-9)
        steps = []
        for n in names:
            h = 1e-5 * float(values[n])
            ends = [numbers(**{n: float(values[n]) + e})[name].value for e in (h, -h)]
            steps.append((ends[0] - ends[1]) / (2.0 * h) * sds[n])
        assert number.sd == pytest.approx(np.linalg.norm(steps), rel=2e-4)


def test_intervals_of_a_measured_response_hold_the_truth():
    """Return a record of a lag with a delay of three samples, with a random stick and noise."""
    dt, n = 0.02, 6000
    num, den, _ = scipy.signal.cont2discrete(([8.0], [T, 1.0]), dt)
    inside = {}
    truth = {}
    lag = {"w180": 0.5, "phase_bandwidth": 0.25}
    for name, angle in lag.items():

        def off(w: float, angle: float = angle) -> float:
            return np.arctan(T * w) + 3 * dt * w - angle * np.pi

        truth[name] = scipy.optimize.brentq(off, 0.1, 60.0)
    w180 = truth["w180"]
    late = np.arctan(2.0 * T * w180) + 6 * dt * w180 - 0.5 * np.pi
    truth["phase_delay"] = late / (2.0 * w180)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.standard_normal(n // 5), 5)
        p = scipy.signal.lfilter(num.ravel(), den, np.concatenate([np.zeros(3), u[:-3]]))
        p = p + 2.0 * rng.standard_normal(n)
        flight = Flight(dt=dt, inputs={"lat": u}, outputs={"p": p})
        found = flight_responses([flight], Settings(band=(0.2, 8.0), window=10.0))
        pair = found.outputs["p"].pairs["lat"]
        H = without_hold(found.omega, pair.H, found.holds["lat"])
        curve = measured_curve(
            found.omega, H, pair.sd * np.abs(H / pair.H), pair.coherence, found.window
        )
        for name, v in handling_qualities(integrated(curve)).numbers.items():
            if name in truth:
                inside.setdefault(name, []).append(v.lower95 < truth[name] < v.upper95)
    assert all(len(v) == 12 for v in inside.values())
    # A bound for three dozen dependent numbers.
    assert 0.86 < np.mean(list(inside.values())) <= 1.0
