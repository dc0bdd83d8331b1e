"""Values with equal responses, against the exchange of two modes by hand."""

from typing import Annotated, Any, NamedTuple

import numpy as np
import pytest

from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.identification.fit import check
from heli_jax.identification.problem import Free, Nuisance, Problem

ZNU, DT, N = 6.0, 0.02, 2000


class Params(NamedTuple):
    Zw: Annotated[Any, "1/s", "heave damping"] = -0.55
    Kn: Annotated[Any, "m/s", "inflow by collective"] = 1.26
    tn: Annotated[Any, "s", "lag of the inflow"] = 0.11
    Zc: Annotated[Any, "m/s^2", "acceleration by collective"] = -28.0


class State(NamedTuple):
    w: Annotated[Any, "m/s", "heave"]
    nu: Annotated[Any, "m/s", "inflow"]


class Inputs(NamedTuple):
    col: Annotated[Any, "1", "collective"]


class Outputs(NamedTuple):
    az: Annotated[Any, "m/s^2", "acceleration"]


def rate(p, s, u):
    return p.Zw * s.w + ZNU * s.nu + p.Zc * u.col


MODEL = Model(
    "heave with inflow",
    lambda p, s, u: State(rate(p, s, u), (p.Kn * u.col - s.nu) / p.tn),
    lambda p, s, u: Outputs(rate(p, s, u)),
    Params,
    State,
    Inputs,
    Outputs,
    axes=(),
    positive=("tn",),
    linear=True,
)
START = Params()
FREE = {
    "Zw": Free(-0.55, sign="any"),
    "Kn": Free(1.26, sign="any"),
    "tn": Free(0.11),
    "Zc": Free(-28.0),
}


def exchanged(Zw, Kn, tn, Zc):
    """Return by hand the values with both poles exchanged, zero and gain unchanged.

    az/col = Zc s (s + (1 + ZNU Kn / Zc)/tn) / ((s - Zw)(s + 1/tn))
    """
    zero = (1.0 + ZNU * Kn / Zc) / tn
    lag = -1.0 / Zw
    return {"Zw": -1.0 / tn, "Kn": (zero * lag - 1.0) * Zc / ZNU, "tn": lag, "Zc": Zc}


@pytest.fixture(scope="module")
def flight():
    """Return a record by small Euler steps: gusts of 0.35 m/s^2, correlation time 0.4 s."""
    rng, h, parts = np.random.default_rng(5), DT / 20, 20
    col = 0.1 * np.repeat(rng.choice([-1.0, 0.0, 1.0], N // 50), 50)
    w = nu = g = 0.0
    az = np.zeros(N)
    keep = np.exp(-h / 0.4)
    pushes = 0.35 * np.sqrt(1 - keep**2) * rng.standard_normal((N, parts))
    for k in range(N):
        az[k] = -0.55 * w + ZNU * nu - 28.0 * col[k] + g
        for push in pushes[k]:
            dw = -0.55 * w + ZNU * nu - 28.0 * col[k] + g
            w, nu, g = w + h * dw, nu + h * (1.26 * col[k] - nu) / 0.11, keep * g + push
    az += 0.1 * rng.standard_normal(N)
    return Flight(dt=DT, inputs={"col": col}, outputs={"az": az})


def asked(flight, free):
    problem = Problem(MODEL, START, [flight], free, Nuisance(bias=False, initial_state=False))
    return [one.values for one in check(problem).verdict.second]


def test_two_modes_that_change_places_answer_alike(flight):
    values = {n: f.start for n, f in FREE.items()}
    [found] = asked(flight, FREE)
    assert found == pytest.approx(exchanged(**values), rel=1e-3)
    # And back again.
    there = {n: f._replace(start=found[n]) for n, f in FREE.items()}
    [back] = asked(flight, there)
    assert back == pytest.approx(values, rel=1e-3)


@pytest.mark.slow
def test_none_answers_alike_outside_the_bounds_or_with_a_known_inflow(flight):
    assert asked(flight, {**FREE, "Zw": Free(-0.55, -3.0, -0.1)}) == []
    # The modes can only change places with another share of the inflow.
    assert asked(flight, {n: FREE[n] for n in ("Zw", "tn")}) == []
