"""Spectra of gusts through a vehicle's dynamics, and parameters unaffected by feedback."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from heli_jax.identification.diagnostics.loop import moved_by_feedback
from heli_jax.identification.estimation.frequency_lines import Matrices
from heli_jax.identification.estimation.frequency_noise import (
    inverse_roots,
    smoothed,
    whitening_by,
)
from heli_jax.identification.validation.follows_response import Feedback

DT, N = 0.02, 4500


def discrete(A: list, B: list) -> tuple[np.ndarray, np.ndarray]:
    n, m = np.shape(B)
    M = np.zeros((n + m, n + m))
    M[:n, :n], M[:n, n:] = A, B
    E = scipy.linalg.expm(M * DT)
    return E[:n, :n], E[:n, n:]


def machine(Ad: np.ndarray, C: np.ndarray) -> Matrices:
    return Matrices(Ad, np.zeros((len(Ad), 0)), C, np.zeros((len(C), 0)))


def gust(rng: np.random.Generator, size: float) -> np.ndarray:
    keeps = np.exp(-DT / 0.5)
    white = size * np.sqrt(1 - keeps**2) * rng.standard_normal(N)
    return scipy.signal.lfilter([1.0], [1.0, -keeps], white)


def test_errors_of_gusts_through_an_integration_and_a_mode_are_whitened():
    """Test against the true spectrum, which a mean over lines misses by far."""
    Ad, _ = discrete([[-0.3, -9.0, 0], [1, 0, 0], [1, 0, 0]], [[0], [0], [0]])
    f = np.arange(1, (N - 1) // 2 + 1) / N
    z = np.exp(2j * np.pi * f)
    H = np.linalg.inv(z[:, None, None] * np.eye(3) - Ad)
    q = 1e-3 / (1.0 + (f / DT * np.pi) ** 2)
    S = q[:, None, None] * H[:, :, :1] @ np.conj(np.swapaxes(H[:, :, :1], 1, 2))
    S = S + np.diag([1e-4, 1e-6, 1e-6])
    rng = np.random.default_rng(0)
    white = (rng.standard_normal((2, 2, f.size, 3)) * [[[[1.0]]], [[[1j]]]]).sum(axis=0) / 2**0.5
    errors = [np.einsum("kij,kj->ki", np.linalg.cholesky(S), v) for v in white]

    def sizes(W: np.ndarray) -> np.ndarray:
        """Return the whitened errors' true covariance over the lowest 10 Hz; it should be one."""
        covariance = (W @ S @ np.conj(np.swapaxes(W, 1, 2)))[: round(10.0 * N * DT)]
        return np.linalg.eigvalsh(covariance)

    by = sizes(whitening_by(machine(Ad, np.eye(3)), errors)[0])
    plain = sizes(inverse_roots(smoothed(errors)[0]))
    assert np.mean(by) == pytest.approx(1.0, abs=0.1)
    # A rate and its integral determine it far better than a mean over lines.
    assert np.quantile(by, [0.0, 0.01, 0.99, 1.0]) == pytest.approx([0.4, 0.7, 1.2, 1.2], abs=0.2)
    assert np.quantile(plain, 0.01) < 0.02
    assert np.max(plain) > 2.0


def test_a_state_that_no_output_shows_takes_no_part_in_the_spectrum():
    """Test a state that is rounding only.

    Taken for a huge gust, it changed the whitening by a tenth with the last digit of the
    parameters.
    """
    Ad, _ = discrete([[-2.0, 0, 0.3], [1, 0, 0], [0.7, 0.1, -1.0]], [[0], [0], [0]])
    Ad[:2, 2] = 0.0
    rng = np.random.default_rng(0)
    K = (N - 1) // 2
    f = np.arange(1, K + 1) / K
    colour = 1e-3 / (0.02 + f[:, None])
    errors = [
        colour * (rng.standard_normal((K, 2)) + 1j * rng.standard_normal((K, 2))) for _ in range(2)
    ]
    alone = whitening_by(machine(Ad[:2, :2], np.eye(2)), errors)[0]
    for rounding in (0.0, 1e-17, -1e-16):
        Ad[:2, 2] = rounding
        by = whitening_by(machine(Ad, np.eye(3)[:2]), errors)[0]
        assert np.max(np.abs(by - alone)) < 1e-9 * np.max(np.abs(alone))


def test_a_closed_loop_is_said_only_of_inputs_without_an_instrument():
    moved = {"Mm": 0.6, "Ll": 0.3, "Lp": 0.1}
    loops = [Feedback("one", n, "p", 0.3, (0.1, 0.1), 1e-6) for n in ("lat", "lon")]
    [found] = trust(moved, loops)
    assert (found.code, found.severity) == ("loop.no-instrument", "doubt")
    assert found.distrusts == ("Mm", "Ll")
    assert trust(moved, loops, ("lat", "lon")) == []
    [found] = trust(moved, loops, ("lat",))
    assert found.distrusts == ("Mm", "Ll", "Lp")
    assert trust({"Lp": 0.003}, loops) == []
    # However coherent residual and response are, there was no loop.
    open_loop = [one._replace(p_value=0.5) for one in loops]
    assert trust(moved, open_loop) == []
    [found] = trust(moved, open_loop, held=True)
    assert found.distrusts == ("Mm", "Ll")


def trust(moved, feedback, instruments=(), *, held=False):
    """Return the findings of a fit with such a loop."""
    follows = any(one.present for one in feedback)
    context = SimpleNamespace(
        moved=moved, feedback=feedback, instruments=instruments, held=held, follows=follows
    )
    return list(moved_by_feedback(context))
