"""Rate loops of the whole helicopter use body rates; delay lines with zero and negative delay."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from heli_jax import linear_model, models, naming, simulate
from heli_jax.analysis.linear import eigenmodes, modes
from heli_jax.dynamics.disturbance import with_disturbance
from tests.dynamics.full_helicopter import FULL

ROLL = linear_model("roll-flybarless")
LATE = models.with_servos(ROLL.model, ["lat"], delay=True)
LOOP = models.with_rate_loop(LATE, ["lat"], feedforward=False, integral=False)


def body_rates(phi, theta, dphi, dtheta, dpsi):
    """Return the body rates from the rotation matrix: R' = R times their cross matrix."""

    def turned(t):
        f, h, y = phi + dphi * t, theta + dtheta * t, dpsi * t
        roll = [[1, 0, 0], [0, np.cos(f), -np.sin(f)], [0, np.sin(f), np.cos(f)]]
        pitch = [[np.cos(h), 0, np.sin(h)], [0, 1, 0], [-np.sin(h), 0, np.cos(h)]]
        yaw = [[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]]
        return np.array(yaw) @ pitch @ roll

    step = 1e-5
    cross = turned(0.0).T @ (turned(step) - turned(-step)) / (2 * step)
    return cross[2, 1], cross[0, 2], cross[1, 0]


ATTITUDE = {"phi": 1.0, "theta": -0.8, "dphi": 0.3, "dtheta": -0.4, "dpsi": 1.2}
GAINS = {"Kc": 2.0, "Kp": 0.05, "Ki": 0.3, "tau_gyro": 0.02}
STICKS = ("x_roll", "x_pitch", "x_yaw")


def flybarless(**options):
    bare = models.helicopter(flybarless=True)
    loops = models.with_rate_loop(bare, feedforward=False, **options)
    return bare, models.with_gyro(loops, **options)


def point(bare, model):
    """Return parameters, state and inputs of both at a large bank and pitch."""
    gains = {f"{gain}_{stick}": value for gain, value in GAINS.items() for stick in STICKS}
    # All have one type, so that one program serves every test.
    one = np.float64(1.0)
    gains = {n: v * one for n, v in gains.items() if n in naming.names(model.Params)}
    p = model.Params(**naming.asdict(bare.Params(**FULL)), **gains)
    state = dict.fromkeys(naming.names(model.State), 0.0) | ATTITUDE
    state |= {"Omega": FULL["Omega"], "governor": 0.5}
    s = model.State(**{n: v * one for n, v in state.items()})
    sticks = {"x_roll": 0.1, "x_pitch": 0.0, "x_yaw": -0.2, "x_collective": 0.5, "x_throttle": 1.0}
    return p, s, bare.Inputs(**{n: v * one for n, v in sticks.items()})


def test_the_loops_of_a_helicopter_close_on_the_rates_of_its_body():
    bare, model = flybarless(lag=False)
    p, s, u = point(bare, model)
    expected = body_rates(**ATTITUDE)
    d = model.vector_field(p, s, u)
    # Kc times the stick, less the rate.
    found = [getattr(d, f"{stick}_integral") for stick in STICKS]
    commands = np.array([0.2, 0.0, -0.4])
    np.testing.assert_allclose(found, commands - expected, atol=1e-9)
    # Kp times the same error reaches the swashplate.
    asked = dict(zip(STICKS, 0.05 * (commands - expected), strict=True))
    inner = bare.State(**{n: getattr(s, n) for n in naming.names(bare.State)})
    driven = bare.vector_field(p, inner, u._replace(**asked))
    for name, rate in naming.asdict(driven).items():
        np.testing.assert_allclose(getattr(d, name), rate, rtol=1e-7, atol=1e-7, err_msg=name)
    assert naming.unit(model.State, "x_yaw_integral") == "rad"


def test_a_lagged_gyro_follows_the_rates_of_the_body():
    bare, model = flybarless(lag=True)
    p, s, u = point(bare, model)
    d = model.vector_field(p, s, u)
    found = [getattr(d, f"{stick}_gyro") for stick in STICKS]
    np.testing.assert_allclose(found, np.array(body_rates(**ATTITUDE)) / 0.02, atol=1e-7)


def test_the_rate_of_a_loop_may_be_named():
    bare = models.helicopter(flybarless=True)
    by_name = models.with_gyro(bare, {"x_yaw": "r"})
    assert by_name is models.with_gyro(bare)
    # Gusts do not change body rates.
    gusty = models.with_gyro(with_disturbance(bare, "yaw"))
    p, s, u = point(bare, gusty)
    d = gusty.vector_field(p, s, u)
    assert float(d.x_yaw_gyro) == pytest.approx(body_rates(**ATTITUDE)[2] / 0.02)
    # The paper's only rates are the angles' derivatives.
    paper = models.helicopter("paper")
    with pytest.raises(ValueError, match="x_yaw: model helicopter-paper has no state 'r'"):
        models.with_gyro(paper, {"x_yaw": "r"})
    assert paper.body_rates is None


def turning(s):
    return {"yaw": s.p}


def late(delay):
    values = naming.asdict(ROLL.vehicle().params)
    values |= {"omega_servo": 50.0, "zeta_servo": 0.7, "Kc_lat": 3.0, "Kp_lat": 0.05}
    return LOOP.Params(**values, delay_servo=delay)


def test_a_delay_line_of_no_delay_passes_its_signal_on():
    # p/lat of the rotor and the servo, in the loop, by hand.
    gain = 166.1 * 0.1398 / 0.04631 * 50.0**2
    open_loop = np.polymul([1, 1 / 0.04631, 166.1], [1, 2 * 0.7 * 50.0, 50.0**2])
    closed = np.polyadd(open_loop, [0.05 * gain])
    A, B, C, _ = scipy.signal.tf2ss([0.15 * gain], closed)
    step = scipy.linalg.expm(0.02 * np.block([[A, B], [np.zeros((1, len(A) + 1))]]))
    x, expected, lat = np.zeros(len(A)), [], np.repeat([0.1, -0.1], 20)
    for u in lat:
        expected.append(float((C @ x)[0]))
        x = (step @ np.append(x, u))[:-1]
    run = simulate(LOOP, late(0.0), LOOP.Inputs(lat=lat), dt=0.02)
    assert int(run.status) == 0
    np.testing.assert_allclose(run.outputs.p, expected, atol=1e-9)
    found = modes(LOOP, late(0.0))
    # In addition there are the line's poles and the angle's zero.
    for pole in np.roots(closed):
        assert np.min(np.abs(found - pole)) < 1e-6
    # The same for the output's line.
    seen = models.with_delays(ROLL.model, outputs=["p"])
    p = seen.Params(**naming.asdict(ROLL.vehicle().params), delay_p=0.0)
    s = seen.State(**dict.fromkeys(naming.names(seen.State), 0.0))._replace(p=jnp.asarray(0.3))
    assert float(seen.output(p, s, seen.Inputs(lat=0.0)).p) == 0.3


def test_a_delay_line_cannot_look_ahead():
    run = simulate(LOOP, late(-0.02), LOOP.Inputs(lat=np.repeat([0.1, -0.1], 20)), dt=0.02)
    assert int(run.status) == 3  # not finite
    for function in (modes, eigenmodes):
        with pytest.raises(ValueError, match=r"delay_servo .* expected 0 s or more, got -0.02 s"):
            function(LOOP, late(-0.02))
