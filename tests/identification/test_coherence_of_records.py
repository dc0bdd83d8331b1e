"""Coherence with the inputs if samples are missing, and rates of modes without oscillation."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from heli_jax.identification.diagnostics.record import of_rates
from heli_jax.identification.validation.excitation import excitation_of
from tests.identification.test_enough import DT, TRUTH, flight, problem, response


def swept(n=4000, noise=0.02):
    """Return a stick of noise below 2 Hz, and the response."""
    rng = np.random.default_rng(0)
    sos = scipy.signal.butter(4, 2.0, fs=1 / DT, output="sos")
    u = scipy.signal.sosfilt(sos, rng.standard_normal(n))
    phi, _ = response(u, np.zeros(n))
    y = phi + noise * np.std(phi) * rng.standard_normal(n)
    return replace(flight(n=n), inputs={"u": u, "v": np.zeros(n)}, outputs={"phi": y})


def test_holes_hardly_change_what_follows():
    f = swept()
    y = f.outputs["phi"]
    sparse = np.full(y.size, np.nan)
    sparse[::5] = y[::5]
    for hole in (slice(0, 0), slice(0, 17), slice(2000, 2100)):
        cut = y.copy()
        cut[hole] = np.nan
        found = excitation_of(problem(replace(f, outputs={"phi": cut, "p": sparse})))
        # An output that is mostly missing is left out.
        assert list(found) == ["phi"]
        assert found["phi"] < 1e-10


def test_modes_that_do_not_swing_ask_for_a_rate_too():
    # 400 = 10 * 40: two decays, the faster of 40 rad/s = 6.4 Hz.
    model = problem(flight(0))
    vehicle = TRUTH._replace(k=400.0, d=50.0, b=220.0)
    free = {n: f._replace(start=getattr(vehicle, n)) for n, f in model.free.items()}
    for every, severity in ((1, "ok"), (3, "doubt"), (8, "refuse")):
        f = flight(0, 3000)
        slow = replace(
            f,
            dt=DT * every,
            inputs={n: u[::every] for n, u in f.inputs.items()},
            outputs={"phi": f.outputs["phi"][::every]},
            sd={"phi": 1e-6},
        )
        asked = replace(model, vehicle=vehicle, flights=(slow,), free=free)
        [found] = of_rates(asked, [{"phi": 1e-6}])
        assert found.severity == severity
        assert found.value == pytest.approx(2.0 * np.pi / 40.0 / (DT * every))
        # A guessed noise as large as the motion hides no mode; a stated one does.
        [guessed] = of_rates(replace(asked, flights=(replace(slow, sd={}),)), [{"phi": 1.0}])
        assert guessed.severity == severity
        assert not list(of_rates(asked, [{"phi": 1.0}]))
