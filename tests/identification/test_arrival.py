"""What is said of a search that did not converge."""

import dataclasses
from types import SimpleNamespace

import numpy as np

from heli_jax import Free, Problem, fit
from heli_jax.identification.diagnostics.search import search_stopped
from tests.identification.test_equation_error import ROLL, Params, record

RNG = np.random.default_rng(0)
J = 30.0 * RNG.standard_normal((400, 3))


def test_a_search_along_what_the_data_leave_open_is_told_what_to_fix():
    """Next to a start of nearly no effect nothing is told; at the optimum all is."""
    flight = record(n=200, noise=0.3)
    flight = dataclasses.replace(flight, inputs={"da": 1e-7 * flight.inputs["da"]})
    problem = Problem(ROLL, Params(-4.0, 25.0, 0.0), [flight], {"Lp": Free(-2.0), "Lda": Free(9.0)})
    found = fit(problem)
    open_before, told = found.verdict_before, found.verdict
    [note] = open_directions(open_before, open_before)
    assert note.subjects == ("Lp", "Lda")
    assert open_directions(open_before, told) == []
    assert open_directions(told, open_before) == []


def open_directions(before, verdict):
    """What is said of a search that stopped."""
    layout = SimpleNamespace(windows=((1, 200),), continuity=None)
    stopped = SimpleNamespace(
        optimum=SimpleNamespace(trace=((9, 1.0),)),
        arrived=False,
        rounding=False,
        at=SimpleNamespace(layout=layout),
        e=SimpleNamespace(J=J),
        before=before,
        verdict=verdict,
    )
    stop, *rest = search_stopped(stopped)
    assert (stop.code, stop.value) == ("search.stopped", 9.0)
    return rest
