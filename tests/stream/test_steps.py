"""One sample at a time against NumPy, and estimates against simulations and the batch fit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Helicopter, Nuisance, Prior, Problem, fit, models, rls, stream
from heli_jax.stream import estimates
from heli_jax.stream.steps import blocks_of
from tests.identification.bench import BENCH, amplitude_for, denominators, response, steps

DT, NOISE = 0.02, 2e-3
VEHICLE = Helicopter(**BENCH)


def problem_of(flight, **keywords):
    free = {"Ixx": Free(0.03), "If": Free(2.2e-4), "kappa": Free(3.0)}
    known = {"method": "frequency-error", "free": free} | keywords
    return Problem(models.roll_on_stand, VEHICLE, [flight], **known)


def flight_of(n, seed=0, noise=NOISE, **keywords):
    rng = np.random.default_rng(seed)
    u = steps(rng, n, DT, amplitude_for(BENCH, DT, stand=True))
    y = response(BENCH, u, DT, stand=True) + noise * rng.standard_normal(n)
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y}, **keywords)


def samples_of(flight):
    return stream.Sample(
        *(
            jnp.asarray(np.stack([by[n] for n in sorted(by)], axis=1))
            for by in (flight.inputs, flight.outputs)
        )
    )


def followed(problem, flight, **keywords):
    state, info = jax.jit(stream.follow)(stream.init(problem, **keywords), samples_of(flight))
    return state, info


@pytest.fixture(scope="module")
def flight():
    return flight_of(2002)


def test_rls_ends_as_the_batch_does(flight):
    state, info = followed(problem_of(flight), flight, forgetting=0.999)
    y, u = flight.outputs["roll"], flight.inputs["x_roll"]
    sizes = [np.sqrt(np.mean(v**2)) for v in (y, u)]
    u, y = jnp.asarray(u / sizes[1]), jnp.asarray(y / sizes[0])
    batch = rls(u, y, order=4, forgetting=0.999, p0=1e12)
    assert np.abs(state.rls.theta - batch.theta).max() < 1e-10
    assert np.abs(info.error[4:] - batch.error[4:]).max() < 1e-10
    assert np.isnan(info.error[:4]).all()


def test_rls_is_least_squares(flight):
    state, _ = followed(problem_of(flight), flight)
    y, u = (v[:, 0] / s for v, s in zip(samples_of(flight)[::-1], state.rls_size, strict=True))
    lags = [v[4 - j : len(y) - j] for v, first in ((y, 1), (u, 0)) for j in range(first, 5)]
    theta = np.linalg.lstsq(np.stack(lags, axis=1), np.asarray(y[4:]), rcond=None)[0]
    assert np.abs(state.rls.theta - theta).max() < 1e-6


def test_the_sums_of_a_block_are_its_fourier_transform(flight):
    state, info = followed(problem_of(flight), flight, block=10.0)
    done = blocks_of(state)
    # Two inputs are kept about each sample, and the last completes the fourth block.
    assert done.count == 4
    assert np.flatnonzero(info.block).tolist() == [501, 1001, 1501, 2001]
    for i in range(4):
        part = slice(1 + 500 * i, 1 + 500 * (i + 1))
        for j, v in enumerate((flight.inputs["x_roll"], flight.outputs["roll"])):
            lines = np.fft.rfft(v[part])[1:250] / np.sqrt(500)
            assert np.abs(done.lines[:, j, i] - lines).max() < 1e-12 * np.abs(lines).max() * 500


def test_steps_are_those_of_a_scan_and_of_a_batch(flight):
    problem = problem_of(flight)
    samples = jax.tree.map(lambda v: v[:600], samples_of(flight))
    whole, _ = jax.jit(stream.follow)(stream.init(problem), samples)
    state, step = stream.init(problem), jax.jit(stream.step)
    for k in range(600):
        state, _ = step(state, jax.tree.map(lambda v, k=k: v[k], samples))
    both = jax.tree.map(lambda v: jnp.stack([v, v]), samples)
    two, _ = jax.vmap(lambda s: stream.follow(stream.init(problem), s))(both)
    for a, b, c in zip(*map(jax.tree.leaves, (whole, state, two)), strict=True):
        size = np.abs(a).max() + 1e-300
        # With P0 of 1e12 the first samples of RLS lose four digits.
        assert np.abs(a - b).max() <= 1e-8 * size
        assert np.abs(a - c[1]).max() <= 1e-8 * size


def test_estimates_are_those_of_the_batch(flight):
    problem = problem_of(flight)
    state, _ = followed(problem, flight, block=10.0)
    known, batch = stream.estimate(problem, state), fit(problem).estimates
    again = stream.estimate(problem, state, known)
    for name, one in known.estimates.items():
        assert abs(one.value - batch[name].value) < 2.0 * batch[name].sd
        assert 0.9 < one.sd / batch[name].sd < 1.7
        assert abs(again.estimates[name].value - one.value) < 0.05 * one.sd
        assert one.lower95 < float(BENCH[name]) < one.upper95
    assert 0.8 < known.coherence["x_roll", "roll"] <= 1.0


def test_a_gap_costs_its_block_alone():
    flight = flight_of(2600, noise=1e-9)
    y = flight.outputs["roll"].copy()
    y[700] = np.nan
    problem = problem_of(flight)
    state, _ = followed(problem, dataclasses.replace(flight, outputs={"roll": y}), block=10.0)
    assert (int(state.missing), int(state.blocks)) == (1, 4)
    for name, one in stream.estimate(problem, state).estimates.items():
        assert one.value == pytest.approx(BENCH[name], rel=1e-5)


@pytest.mark.parametrize(("hold", "late"), [("zero-order", 0.033), ("linear", -0.013)])
def test_delays_are_exact_at_the_ends_of_blocks(hold, late):
    fine, n = 20, 1600
    u = steps(np.random.default_rng(3), n, DT, amplitude_for(BENCH, DT, stand=True))
    # On a grid of a millisecond the input acts `late` s after the log.
    t = np.arange(n * fine) * DT / fine
    acting = np.interp(t, np.arange(n) * DT, u) if hold == "linear" else np.repeat(u, fine)
    shift = round(late * fine / DT)
    acting = np.r_[np.full(max(shift, 0), acting[0]), acting[max(-shift, 0) :]][: n * fine]
    acting = np.r_[acting, np.full(n * fine - acting.size, acting[-1])]
    kind = "foh" if hold == "linear" else "zoh"
    system = scipy.signal.cont2discrete(denominators(BENCH, True), DT / fine, kind)
    y = scipy.signal.lfilter(np.ravel(system[0]), system[1], acting)[::fine]
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y + 1e-9}, hold={"x_roll": hold})
    problem = problem_of(flight, nuisance=Nuisance(time_shift=True))
    state, _ = followed(problem, flight, block=10.0)
    known = stream.estimate(problem, state)
    assert known.estimates["time_shift"].value == pytest.approx(late, abs=2e-6)
    assert known.estimates["Ixx"].value == pytest.approx(BENCH["Ixx"], rel=1e-4)


def test_a_quotient_is_sharper_than_its_parameters(flight):
    free = {"Ixx": Free(0.03), "If": Free(2e-4), "a": Free(5.5, prior=Prior(5.5, 0.5))}
    problem = problem_of(flight, free=free)
    known = stream.estimate(problem, followed(problem, flight, block=10.0)[0])
    one = known.combinations()["a/Ixx"]
    assert one.value == pytest.approx(BENCH["a"] / BENCH["Ixx"], rel=0.02)
    assert one.sd / one.value < 0.1 * known.sd_of("a")
    # The prior alone determines a.
    assert known.estimates["a"].sd == pytest.approx(0.5, rel=0.05)
    assert known.of("a/nothing") is None


def test_the_oldest_block_is_replaced():
    flight = flight_of(1500)
    problem = problem_of(flight)
    state = stream.init(problem, block=1.0)
    long = jax.tree.map(lambda v: jnp.tile(v, (3, 1)), samples_of(flight))
    state, _ = jax.jit(stream.follow)(state, long)
    done = blocks_of(state)
    assert (int(state.blocks), done.count) == (89, 63)
    assert np.isfinite(estimates.estimate(problem, state).sd_of("Ixx"))


def test_what_cannot_be_followed_is_refused(flight):
    with pytest.raises(ValueError, match="mixed"):
        stream.init(problem_of(dataclasses.replace(flight, hold={"x_roll": "mixed"})))
    with pytest.raises(ValueError, match="block"):
        stream.init(problem_of(flight), block=0.5)
    assert stream.estimate(problem_of(flight), stream.init(problem_of(flight))) is None
