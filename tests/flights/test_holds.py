"""Behaviour of inputs between samples, decided from records."""

import numpy as np
import pytest

from heli_jax.flights.holds import decide
from heli_jax.numerics.jumps import jumps

N, DT = 1500, 0.02
T = DT * np.arange(N)


def rng():
    return np.random.default_rng(8)


def random_steps(n=N, low=0.2, high=1.5, dt=DT):
    r, u = rng(), []
    while len(u) < n:
        u += [r.uniform(-1, 1)] * max(1, round(r.uniform(low, high) / dt))
    return np.array(u[:n])


def chirp(t=T, top=3.0):
    return np.sin(2 * np.pi * (0.1 * t + 0.5 * (top - 0.1) / t[-1] * t**2))


def with_pauses():
    return np.where((T // 5).astype(int) % 3 == 0, chirp(), 0.0)


def pilot(dt=DT, n=N):
    """Return a smooth stick: random accelerations through two lags of 0.15 s."""
    r, x, v, u = rng(), 0.0, 0.0, []
    for _ in range(n):
        v += dt * ((2 * r.standard_normal() / np.sqrt(dt) - x) / 0.0225 - 2 * v / 0.15)
        x += dt * v
        u.append(x)
    return np.array(u)


def doublets(ramp):
    """Return a stick with ramps of `ramp` samples, not synchronous with the clock."""
    corners, values = [0.0], [0.0]
    for start in np.arange(2.0037, T[-1] - 4, 3.0111):
        for level in (1.0, -1.0, 0.0):
            corners += [start, start + 0.5 * ramp * DT * abs(level - values[-1])]
            values += [values[-1], level]
            start += 0.7
    return np.interp(T, corners, values)


def multistep(unit):
    """Return a 3-2-1-1 with pauses: three values."""
    pattern = [1] * 3 + [-1] * 2 + [1] + [-1] + [0] * 8
    return np.resize(np.repeat(np.array(pattern, float), unit), N)


def counts(u, per_unit=400, centre=1500):
    """Return the stick as pulse widths of whole microseconds."""
    return np.round(centre + per_unit * u)


STEPS = {
    "random steps": random_steps(),
    "random steps of two to four samples": random_steps(low=2 * DT, high=4 * DT),
    "3-2-1-1 of 15 samples": multistep(15),
    "3-2-1-1 of one sample": multistep(1),
    "two values at random": rng().choice([-1.0, 1.0], N),
    "one step": np.where(T < 10, 0.0, 1.0),
    "one step with one count of noise": counts(np.where(T < 10, 0.0, 0.3))
    + rng().integers(0, 2, N),
    "one step and back": np.where((T > 10) & (T < 12), 0.3, 0.0),
    "steps with one count of noise": counts(random_steps()) + rng().integers(-1, 2, N),
    "small steps with one count of noise": counts(0.1 * random_steps()) + rng().integers(0, 2, N),
    "steps with analogue noise": random_steps() + 0.005 * rng().standard_normal(N),
    "dead stick with one count of noise": counts(np.zeros(N)) + rng().integers(0, 2, N),
    "never moves": np.full(N, 0.7),
    "smooth stick read at 50 Hz, logged at 100": np.repeat(pilot(), 2)[:N],
    "smooth stick read at 50 Hz, logged at 200": np.repeat(counts(0.3 * pilot()), 4)[:N],
    "smooth stick read at 50 Hz, logged at 125": pilot()[(np.arange(N) * 0.4).astype(int)],
    "smooth stick read at 50 Hz, logged at 250": pilot()[(np.arange(N) * 0.2).astype(int)],
}


def card(dt=DT, n=N):
    """Return doublets of the stick followed by a chirp, in one record."""
    u, t = np.zeros(n), dt * np.arange(n)
    for k, (width, size) in enumerate([(0.4, 3.0), (0.3, -4.0), (0.6, 3.0), (0.24, 5.0)]):
        first, length = round((1.0 + 3.0 * k) / dt), round(width / dt)
        u[first : first + length] += size
        u[first + length : first + 2 * length] -= size
    return u + 3.0 * np.where(t > 14, np.sin(2 * np.pi * (0.2 * (t - 14) + 0.1 * (t - 14) ** 2)), 0)


MIXED = {
    "doublets and a chirp": card(),
    "doublets and a chirp in pulse widths": counts(0.2 * card()),
    "doublets and a chirp with noise": card() + 0.01 * rng().standard_normal(N),
    "doublets and a chirp at 100 Hz": card(0.01, 2 * N),
    "doublets and a chirp, samples missing": np.delete(card(), rng().choice(N, 100)),
    "chirp with pauses": with_pauses(),
    "chirp with pauses in counts": counts(with_pauses()),
    "chirp between long neutral": np.where((T > 12) & (T < 18), chirp(), 0.0),
    "chirp and the jump of a switch": 0.2 * chirp() + (T > 15),
}

MOVING = {
    "chirp": chirp(),
    "chirp to 8 Hz": chirp(top=8.0),
    "chirp in counts": counts(chirp()),
    "pilot": pilot(),
    "pilot in counts": counts(0.3 * pilot()),
    "pilot at 10 Hz": pilot(0.1),
    "pilot at 400 Hz in counts": counts(0.3 * pilot(0.0025)),
    "pilot with noise": pilot() + 0.01 * rng().standard_normal(N),
    "slow, one count at a time": counts(0.1 * np.sin(0.3 * T)),
    "doublets with a rate limit": doublets(6),
    "doublets with a rate limit in counts": counts(doublets(6)),
    "doublets with a fast rate limit": doublets(4),
    "white": rng().standard_normal(N),
    "sum of sines": sum(np.sin(w * T + w) for w in (0.7, 1.9, 4.1, 7.3)),
    "feedback of a noisy rate": 0.3 * pilot() + 0.05 * rng().standard_normal(N),
}


@pytest.mark.parametrize("name", STEPS)
def test_commanded_in_steps(name):
    assert decide(STEPS[name]).hold == "zero-order"


@pytest.mark.parametrize("name", MOVING)
def test_sampled_while_it_moved(name):
    assert decide(MOVING[name]).hold == "linear"


@pytest.mark.parametrize("name", MIXED)
def test_both_in_one_record(name):
    assert decide(MIXED[name]).hold == "mixed"


def test_the_jumps_of_a_test_card():
    """Test that the edges of the doublets are jumps, and no sample of the chirp."""
    at = np.flatnonzero(jumps(card()))
    edges = np.flatnonzero(np.diff(card()))
    np.testing.assert_array_equal(at, edges[edges < 690])
    assert at.size == 12


@pytest.mark.parametrize("name", [*STEPS, *MOVING, *MIXED])
def test_units_and_signs_do_not_matter(name):
    values = {**STEPS, **MOVING, **MIXED}[name]
    for factor, offset in ((-1.0, 0.0), (1.7e-6, 3e-5), (180 / np.pi, -2.0), (1e300, 0.0)):
        assert decide(factor * values + offset) == decide(values)


def test_a_single_absurd_number_changes_no_hold():
    rng = np.random.default_rng(4)
    steps = np.repeat(rng.uniform(-0.2, 0.2, 40), 150)
    assert decide(steps).hold == "zero-order"
    jumped = jumps(steps)
    steps[1234] = 50.0
    assert decide(steps).hold != "linear"
    np.testing.assert_array_equal(jumps(steps), jumped)
    smooth = np.sin(0.01 * np.arange(6000))
    smooth[1234] = 50.0
    assert decide(smooth).hold == "linear"
