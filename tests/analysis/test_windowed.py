"""Errors of frequency responses: covariance against an explicit linear map from samples."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight
from heli_jax.analysis.spectra import PairOptions, ResponseOptions, windowed
from heli_jax.identification.estimation.response_weights import (
    averages,
    covariance,
    noise_density,
    pairs_used,
    partial_coherence,
    response_of,
    whitening,
)

DT, N, L = 0.05, 600, 100


def flights(noise: np.ndarray) -> list[Flight]:
    """Return two correlated inputs and two outputs, one with a missing sample in one flight."""
    rng = np.random.default_rng(0)
    out = []
    for i, e in enumerate(noise):
        u = np.cumsum(rng.standard_normal((2, N)), axis=1)
        u[1] += 0.5 * u[0]
        y = e.copy()
        if i == 0:
            y[1, 333] = np.nan
        out.append(Flight(dt=DT, inputs={"a": u[0], "b": u[1]}, outputs={"p": y[0], "q": y[1]}))
    return out


def by_hand(flights: list[Flight], line: int) -> np.ndarray:
    """(2, samples of both flights) from white noise on an output to its two responses.

    Windows in which one output lacks a sample are left out of all."""
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(L) / L)
    turn = window * np.exp(-2j * np.pi * line * np.arange(L) / L)
    # The mean of the segment is removed, which matters only near zero frequency.
    turn = turn - np.mean(turn)
    S_uu, rows = np.zeros((2, 2), complex), np.zeros((2, 2 * N), complex)
    for i, f in enumerate(flights):
        for s in range(0, N - L + 1, -(-L // 3)):
            if np.isnan(f.outputs["q"][s : s + L]).any():
                continue
            U = np.array([f.inputs[n][s : s + L] @ turn for n in ("a", "b")])
            S_uu += np.outer(np.conj(U), U)
            rows[:, i * N + s : i * N + s + L] += np.conj(U)[:, None] * turn
    return np.linalg.solve(S_uu, rows)


def test_errors_of_responses_are_those_of_the_linear_map_from_samples():
    rng = np.random.default_rng(1)
    mixed = np.array([[1.0, 0.0], [0.6, 0.8]])
    noise = np.einsum("ij,fjn->fin", mixed, rng.standard_normal((2, 2, N)))
    all_of_them = flights(noise)
    w = windowed(all_of_them, ResponseOptions(window=L * DT))
    at = averages(w)
    assert len(w.Z) == 27
    maps = [by_hand(all_of_them, k) for k in w.numbers[:4]]
    E = response_of(w, at, w.Y)
    white = {n: np.nan_to_num(np.concatenate([f.outputs[n] for f in all_of_them])) for n in "pq"}
    rho = mixed @ mixed.T
    # One-sided density of white noise of variance 1 is twice the sample time.
    density = np.broadcast_to(2.0 * DT * rho, (len(w.numbers), 2, 2)).astype(complex)
    C = covariance(at, density)
    for k in range(4):
        for j, n in enumerate("pq"):
            np.testing.assert_allclose(E[k, j], maps[k] @ white[n], rtol=1e-9)
            for i in range(2):
                expected = rho[j, i] * maps[k] @ np.conj(maps[k]).T
                np.testing.assert_allclose(C[k, j, :, i], expected, rtol=1e-6, atol=1e-12)
    used = np.ones((len(w.numbers), 2, 2), bool)
    used[:, 1, 0] = False
    W = whitening(at, density, used)
    unit = np.einsum("kab,kbc,kdc->kad", W, C.reshape(-1, 4, 4), np.conj(W))
    np.testing.assert_allclose(unit, np.diag([1.0, 1.0, 0.0, 1.0]) + 0 * unit, atol=1e-6)


def test_noise_and_its_correlation_are_found_whatever_the_inputs_explain():
    rng = np.random.default_rng(2)
    mixed = np.array([[1.0, 0.0], [0.6, 0.8]])
    noise = np.einsum("ij,fjn->fin", mixed, rng.standard_normal((8, 2, N)))
    made = flights(noise)
    moved = [
        Flight(
            dt=DT,
            inputs=f.inputs,
            outputs={"p": f.outputs["p"] + 3.0 * f.inputs["a"], "q": f.outputs["q"]},
        )
        for f in made
    ]
    w = windowed(moved, ResponseOptions(window=L * DT))
    at = averages(w)
    S = np.mean(noise_density(w, at, w.Y), axis=0) / (2.0 * DT)
    np.testing.assert_allclose(S, mixed @ mixed.T, atol=0.15)
    coherence = partial_coherence(w, at)
    low = w.hz < 1.0
    assert np.mean(coherence[low, 0, 0]) > 0.9
    assert np.mean(coherence[low, 1, 0]) < 0.1
    pairs = (PairOptions("a", "p", (0.5, 2.0)), PairOptions("a", "q", coherence=0.6))
    used = pairs_used(w, ResponseOptions(pairs=pairs), coherence)
    assert w.hz[used[:, 0, 0]].min() >= 0.5
    assert w.hz[used[:, 0, 0]].max() <= 2.0
    assert not used[:, 1].any()
    assert not used[:, 0, 1].any()


@pytest.mark.parametrize(
    "options",
    [
        ResponseOptions(window=400.0),
        ResponseOptions(window=5.0, band=(0.1, 2.0)),
        ResponseOptions(window=5.0, band=(0.5, 11.0)),
        ResponseOptions(window=5.0, band=(0.41, 0.45)),
        ResponseOptions(window=0.2),
    ],
)
def test_what_does_not_fit_the_flights_is_refused(options):
    with pytest.raises(ValueError, match=r"window|band"):
        windowed(flights(np.zeros((2, 2, N))), options)


def test_a_narrow_mode_is_not_smeared_where_averages_are_many():
    """Test the noise spectrum of a mode at 0.3 Hz in windows of 10 s.

    The reference is the mean of many records, each without smoothing.
    """
    rng, n = np.random.default_rng(2), 2400
    b, a = scipy.signal.bilinear([1.0], [1.0, 0.2, (0.6 * np.pi) ** 2], 1.0 / DT)

    def record() -> Flight:
        y = scipy.signal.lfilter(b, a, rng.standard_normal(n + 1000))[1000:]
        return Flight(dt=DT, inputs={"a": rng.standard_normal(n)}, outputs={"p": np.asarray(y)})

    many = [windowed([record()], ResponseOptions(window=10.0)) for _ in range(60)]
    true = np.mean([np.mean(np.abs(w.Y[:, :, 0]) ** 2, axis=0) for w in many], axis=0)
    found = [np.real(noise_density(w, averages(w), w.Y))[:, 0, 0] for w in many[:20]]
    # Three lines above the mode there is little power, and twice the width makes it 20 times as
    # much.
    above = 5
    assert many[0].hz[above] == pytest.approx(0.6)
    assert np.mean(found, axis=0)[above] < 8.0 * true[above]
