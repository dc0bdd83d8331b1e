"""One flight of several that does not answer as the others do is named."""

import numpy as np
import pytest

from heli_jax import Flight
from heli_jax.identification.validation.excited_band import NOTHING_FOLLOWS, bands
from heli_jax.identification.validation.misread import record_doubts
from heli_jax.identification.validation.odd_flights import odd_flights
from tests.identification.test_enough import DT, problem, response, steps

N = 1000


def good(seed):
    rng = np.random.default_rng(seed)
    u = steps(rng, N)
    phi, p = response(u, np.zeros(N))
    noise = rng.standard_normal((2, N))
    return {"u": u, "phi": phi + 0.003 * noise[0], "p": p + 0.02 * noise[1]}


def flight(x, **known):
    return Flight(
        dt=DT,
        inputs={"u": x["u"], "v": np.zeros(N)},
        outputs={n: x[n] for n in ("phi", "p")},
        known=known,
    )


def dead(x, seed):
    return {**x, "u": np.zeros(N)}


def of_another(x, seed):
    return {**good(seed + 500), "u": x["u"]}


def shuffled(x, seed):
    order = np.random.default_rng(seed).permutation(N // 50)
    return {n: y if n == "u" else y.reshape(-1, 50)[order].ravel() for n, y in x.items()}


def turned(x, seed):
    return {**x, "u": -x["u"]}


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("spoilt", [dead, of_another, shuffled])
def test_a_spoilt_flight_is_named(spoilt, count):
    for seed in range(0, 40, 10):
        columns = [good(seed + i) for i in range(count)]
        columns[-1] = spoilt(columns[-1], seed)
        flights = [flight(x) for x in columns]
        [odd] = odd_flights(flights)
        assert odd.index == count - 1
        assert "phi" in odd.outputs
        assert odd.finding.subjects == (f"flight {count}", *odd.outputs)
        found = bands(flights)
        assert found[0] == odd.finding
        assert NOTHING_FOLLOWS not in {f.code for f in found}
        assert [f for f in record_doubts(problem(*flights)) if f.denies] == [odd.finding]


def test_of_two_flights_against_one_another_neither_is_blamed():
    pair = [flight(good(1)), flight(turned(good(2), 2))]
    assert odd_flights(pair) == []
    [odd] = odd_flights([flight(good(3)), *pair])
    assert odd.index == 2


@pytest.mark.parametrize("size", [1.0, 0.7])
def test_of_a_turned_column_its_sign_is_named(size):
    """Of a smaller sweep too, which the test of signs at the start values leaves to the others."""
    flights = [flight(good(1)), flight(good(2))]
    x = {n: size * v for n, v in good(3).items()}
    [odd] = odd_flights([*flights, flight({**x, "p": -x["p"]})])
    assert odd.turned == ("p",)
    [odd] = odd_flights([*flights, flight(turned(x, 3))])
    assert odd.turned == ("phi", "p")
    [odd] = odd_flights([*flights, flight(shuffled(x, 3))])
    assert odd.turned == ()


def test_flights_of_one_machine_are_not_odd():
    for seed in range(0, 100, 4):
        flights = [flight(good(seed + i)) for i in range(4)]
        assert odd_flights(flights) == []
    # One in which hardly anything moves says little, and nothing against the others.
    rng = np.random.default_rng(1)
    quiet = good(7)
    quiet = {"u": 1e-3 * quiet["u"], "phi": 1e-3 * quiet["phi"], "p": 1e-3 * quiet["p"]}
    quiet |= {"phi": quiet["phi"] + 0.003 * rng.standard_normal(N)}
    quiet |= {"p": quiet["p"] + 0.02 * rng.standard_normal(N)}
    assert odd_flights([flight(good(1)), flight(good(2)), flight(quiet)]) == []


def test_flights_with_a_stick_each_are_not_held_against_one_another():
    flights = []
    for i in range(3):
        x, y = good(i), good(i + 50)
        inputs = {n: y["u"] if i == k else np.zeros(N) for k, n in enumerate("uvw")}
        outputs = {n: x[n] + (i == 0) * y[n] for n in ("phi", "p")}
        flights.append(Flight(dt=DT, inputs=inputs, outputs=outputs))
    assert odd_flights(flights) == []


def test_flights_with_other_known_parameters_are_not_compared():
    flights = [flight(good(1)), flight(good(2)), flight(turned(good(3), 3), k=1.0)]
    assert odd_flights(flights) == []
