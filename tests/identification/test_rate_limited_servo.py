"""A rate-limited servo: simulation against SciPy, and one optimum from different starts."""

import itertools
import math

import numpy as np
from scipy.integrate import solve_ivp

from heli_jax import linear_model, models, naming, simulate

ROLL = linear_model("roll-flybarless")
MODEL = models.with_servos(ROLL.model, ["lat"], rate_limit=True, delay=True)
TRUE = {"Lb": 150.0, "tau_f": 0.05, "Blat": 0.14, "delay_servo": 0.0153, "rate_servo": 3.0}
OMEGA, ZETA = 2.0 * math.pi * 9.0, 0.7
DT = 0.01


def stick(n):
    """Return random doublets at 1 kHz, with edges between the n samples of the log."""
    rng, u, at = np.random.default_rng(5), np.zeros(10 * n), 200
    while at < 10 * n - 900:
        size, length = rng.uniform(0.15, 0.5) * rng.choice([-1, 1]), int(rng.integers(150, 400))
        u[at : at + length], u[at + length : at + 2 * length] = size, -size
        at += 2 * length + int(rng.integers(100, 400))
    return u


def to_the_next_kink(x, t, end, command):
    """Run solve_ivp from x at t until the limit begins or ends, or until `end`."""
    lb, tau, blat, _, most = TRUE.values()

    def asked(y):
        return OMEGA / (2.0 * ZETA) * (command - y[3])

    now = asked(x)
    limited = abs(now) > most
    if abs(abs(now) - most) < 1e-9:  # at the limit: on the way up or down
        limited = now * x[4] < 0

    def rates(_, y):
        speed = math.copysign(most, now) if limited else asked(y)
        flapping = -y[1] - y[2] / tau + blat / tau * y[3]
        return [y[1], lb * y[2], flapping, y[4], 2.0 * ZETA * OMEGA * (speed - y[4])]

    def meets(_, y):
        return abs(asked(y)) - most

    meets.terminal, meets.direction = True, -1.0 if limited else 1.0
    how = {"rtol": 1e-10, "atol": 1e-12, "events": meets, "dense_output": True}
    return solve_ivp(rates, (t, end), x, "DOP853", **how)


def by_events(u, dt, times):
    """Return phi and p at `times` [s] of a servo that limits its commanded speed.

    The equations are solved anew from every edge and every begin and end of the limit.
    """
    late = TRUE["delay_servo"]
    edges = dt * (np.flatnonzero(np.diff(u)) + 1) + late
    edges = [0.0, *edges[edges < times[-1]], times[-1]]
    x, found = np.zeros(5), np.zeros((2, times.size))
    for begin, end in itertools.pairwise(edges):
        command = u[max(int((0.5 * (begin + end) - late) / dt), 0)]
        t = begin
        while t < end - 1e-12:
            run = to_the_next_kink(x, t, end, command)
            here = (times >= t - 1e-12) & (times <= run.t[-1] + 1e-12)
            if here.any():
                found[:, here] = run.sol(times[here])[:2]
            t, x = run.t[-1], run.y[:, -1]
    return found


def params(**values):
    known = naming.asdict(ROLL.vehicle().params)
    return MODEL.Params(**{**known, "omega_servo": OMEGA, "zeta_servo": ZETA, **values})


def test_it_is_simulated_as_scipy_does_from_kink_to_kink():
    logged = stick(600)[::10]
    times = DT * np.arange(600)
    phi, p = by_events(logged, DT, times)
    assert np.max(np.abs(p)) > 1.0
    run = simulate(MODEL, params(**TRUE), MODEL.Inputs(lat=logged), dt=DT)
    # A tenth of a gyro's resolution, at the steps of a fit.
    np.testing.assert_allclose(run.outputs.p, p, atol=2e-4)
    np.testing.assert_allclose(run.outputs.phi, phi, atol=2e-4)
