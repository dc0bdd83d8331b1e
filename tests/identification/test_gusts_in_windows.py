"""What a machine makes of gusts in windows, against the covariance of its samples written out."""

import numpy as np
import scipy.linalg

from heli_jax import Flight
from heli_jax.analysis.spectra import ResponseOptions, hann, windowed
from heli_jax.identification.estimation.response_weights import (
    averages,
    described,
    noise_density,
    ways_of,
)

DT, L, N = 0.05, 200, 2400
C = np.array([[1.0, 0.0], [0.3, 1.0]])


def machine() -> np.ndarray:
    """A mode at 0.3 Hz, damped to 5 %: narrower than a line of windows of 10 s."""
    omega = 0.6 * np.pi
    return scipy.linalg.expm(DT * np.array([[0.0, 1.0], [-(omega**2), -0.1 * omega]]))


def test_windows_show_what_the_covariance_of_samples_says():
    Ad, lines = machine(), np.arange(1.0, 9.0)
    ways = ways_of(Ad, C, lines, L)
    t = np.arange(L)
    for state in range(2):
        P = scipy.linalg.solve_discrete_lyapunov(Ad, np.diag(np.eye(2)[state]))
        powers = np.stack([C @ np.linalg.matrix_power(Ad, k) @ P @ C.T for k in t])
        lag = t[:, None] - t[None, :]
        each = powers[np.abs(lag)]
        R = np.where((lag < 0)[:, :, None, None], np.swapaxes(each, 2, 3), each)
        for k, line in enumerate(lines):
            g = hann(L) * np.exp(-2j * np.pi * line * t / L)
            g = g - np.mean(g)
            expected = np.einsum("s,stij,t->ij", g, R, np.conj(g)) / np.sum(hann(L) ** 2)
            scale = np.sqrt(np.outer(np.diag(expected).real, np.diag(expected).real))
            # The main lobe alone: what sidelobes bring of the mode is a few per cent far from it.
            np.testing.assert_allclose(ways[k, state] / scale, expected / scale, atol=0.1)


def test_the_mean_over_lines_leaves_a_mode_as_narrow_as_it_is():
    """The spectrum of two outputs in gusts, against that of many records without any mean."""
    rng, Ad = np.random.default_rng(4), machine()

    def record() -> Flight:
        kicks = rng.standard_normal((N + 600, 2)) * [0.0, 1.0]
        x, states = np.zeros(2), []
        for kick in kicks:
            states.append(x)
            x = Ad @ x + kick
        y = (np.array(states[600:]) @ C.T + 0.3 * rng.standard_normal((N, 2))).T
        return Flight(
            dt=DT, inputs={"a": rng.standard_normal(N)}, outputs=dict(zip("pq", y, strict=True))
        )

    many = [windowed([record()], ResponseOptions(window=L * DT)) for _ in range(40)]
    true = np.mean([np.mean(np.abs(w.Y) ** 2, axis=0) for w in many], axis=0)

    def off(shaped: bool) -> np.ndarray:
        found = [
            noise_density(w, averages(w), w.Y, described(Ad, C, w) if shaped else None)
            for w in many[:10]
        ]
        own = np.real(np.einsum("wkii->wki", np.array(found)))
        return np.max(np.abs(np.log(np.mean(own, axis=0) / true))[1:20], axis=0)

    assert np.all(off(shaped=True) < 0.35)
    assert np.all(off(shaped=False) > 0.7)
