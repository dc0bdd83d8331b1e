"""Fits in the frequency domain on the disturbed bench, relative to the Cramér-Rao bound.

    .venv/bin/python experiments/frequency_response.py [RUNS] [WINDOW]

Records of 120 s are made with SciPy alone, with pilot steps or a chirp. Gusts are as large as the
stick's response, or absent; Ixx, If and kappa start off by a factor of 1.3. `frequency-response`
(in windows of WINDOW, 20 s) and `frequency-error` fit the same records. The bound is for known gust
spectrum and noise: the sensitivities of the response after the Kalman filter that whitens gusts and
noise. Coverage counts only stated 95 % intervals; a parameter that is not identifiable has none.
"""

import time
from collections.abc import Callable

import jax
import numpy as np
import scipy.linalg
import scipy.signal
from coverage_cases.disturbed import matrices, response
from frequency_error import DT, NAMES, NOISE, SAMPLES, TAU, VEHICLE, steps

from heli_jax import Flight, Free, Problem, fit, models, naming
from heli_jax.analysis.spectra import ResponseOptions
from heli_jax.identification.result import Fit

jax.config.update("jax_enable_x64", True)
METHODS = ("frequency-response", "frequency-error")


def chirp(rng: np.random.Generator) -> np.ndarray:
    """Return a chirp from 0.1 to 5 Hz with equal time per octave and a random phase."""
    t = DT * np.arange(SAMPLES)
    hz = 0.1 * 50.0 ** (t / t[-1])
    return 1.7e-6 * np.sin(2.0 * np.pi * (np.cumsum(hz) * DT + rng.uniform()))


def still(v, u: np.ndarray) -> np.ndarray:
    """Return roll (N,) without gusts."""
    A, B = matrices(v)
    M = np.zeros((5, 5))
    M[:4, :4], M[:4, 4] = A, B
    E = scipy.linalg.expm(M * DT)
    num, den = scipy.signal.ss2tf(E[:4, :4], E[:4, 4:], np.eye(4)[:1], np.zeros((1, 1)))
    return np.asarray(scipy.signal.lfilter(num[0], den, u))


def bound(u: np.ndarray, sigma: float) -> np.ndarray:
    """Return relative Cramér-Rao standard deviations (3,) for known gusts and noise."""
    rows, h = [], 1e-4
    for name in NAMES:
        value = float(getattr(VEHICLE, name))
        up, down = (
            still(naming.replace(VEHICLE, **{name: value * (1 + s * h)}), u) for s in (1, -1)
        )
        rows.append((up - down) / (2 * h))
    white = whitened(np.array(rows).T, sigma)
    return np.sqrt(np.diag(np.linalg.inv(white.T @ white)))


def whitened(s: np.ndarray, sigma: float) -> np.ndarray:
    """Return signals (N, q), whitened for gusts and noise, over the innovations' sd."""
    A = np.zeros((5, 5))
    A[:4, :4] = matrices(VEHICLE)[0]
    A[1, 4], A[4, 4] = 1.0, -1.0 / TAU
    G = np.zeros((5, 5))
    G[4, 4] = 2.0 * sigma**2 / TAU
    both = scipy.linalg.expm(np.block([[-A, G], [np.zeros((5, 5)), A.T]]) * DT)
    Ad, Q = both[5:, 5:].T, both[5:, 5:].T @ both[:5, 5:]
    P, x, out = np.diag([0.0, 0.0, 0.0, 0.0, sigma**2]), np.zeros((5, s.shape[1])), np.empty_like(s)
    for k, row in enumerate(s):
        S = P[0, 0] + NOISE**2
        K = P[:, 0] / S
        out[k] = (row - x[0]) / S**0.5
        x = Ad @ (x + np.outer(K, row - x[0]))
        P = Ad @ (P - np.outer(K, P[0])) @ Ad.T + Q
    return out


def record(rng: np.random.Generator, u: np.ndarray, sigma: float) -> Flight:
    """Return the roll record for a stick u in gusts of sigma [rad/s^2]."""
    roll = response(VEHICLE, u, DT, sigma, TAU, rng)[:, 0]
    roll = roll + NOISE * rng.standard_normal(SAMPLES)
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": roll})


def one_fit(
    flight: Flight, method: str, window: float | None
) -> tuple[Fit, np.ndarray, np.ndarray]:
    """Return a fit from 1.3 times the truth, relative errors, and coverage of the 95 % intervals.

    Coverage is NaN if no interval is stated.
    """
    truth = np.array([float(getattr(VEHICLE, n)) for n in NAMES])
    free = {n: Free(1.3 * t) for n, t in zip(NAMES, truth, strict=True)}
    options = ResponseOptions(window=window)
    problem = Problem(
        models.roll_on_stand, VEHICLE, [flight], free, method=method, frequency=options
    )
    found = fit(problem)
    error = np.array([found.estimates[n].value for n in NAMES]) - truth
    ends = [(found.estimates[n].lower95, found.estimates[n].upper95) for n in NAMES]
    held = [
        np.nan if a is None or b is None else float(a <= t <= b)
        for (a, b), t in zip(ends, truth, strict=True)
    ]
    return found, error / truth, np.array(held)


def one_run(
    seed: int, move: Callable, sigma: float, window: float
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, float, float]]:
    """Return by method: relative errors, coverage, the bound, the time, chi-squared's result.

    The last is 1 if chi-squared is in its expected interval, NaN if there is none.
    """
    rng = np.random.default_rng(seed)
    u = move(rng)
    flight = record(rng, u, sigma)
    least, out = bound(u, sigma), []
    for method in METHODS:
        began = time.perf_counter()
        found, error, held = one_fit(flight, method, window if method == METHODS[0] else None)
        took = time.perf_counter() - began
        inside = np.nan
        if (responses := found.responses) is not None:
            inside = responses.lower95 < responses.chi_squared < responses.upper95
        out.append((error, held, least, took, float(inside)))
    return out


def main(runs: int, window: float) -> None:
    print(
        "| stick | gusts [rad/s^2] | method | " + " | ".join(NAMES) + " | time [s] | chi2 inside |"
    )
    print("|---|---|---|" + "---|" * (len(NAMES) + 2))
    for sigma in (1.04, 0.0):
        for move in (steps, chirp):
            each = [one_run(seed, move, sigma, window) for seed in range(runs)]
            for k, method in enumerate(METHODS):
                of_method = zip(*(run[k] for run in each), strict=True)
                error, held, least, took, inside = (np.array(v) for v in of_method)
                rmse = np.sqrt(np.mean(error**2, axis=0))
                ratio = np.sqrt(np.mean((error / least) ** 2, axis=0))
                stated = np.sum(np.isfinite(held), axis=0)
                covered = np.nansum(held, axis=0) / np.maximum(stated, 1)
                cells = [
                    f"{100 * a:.3g} %, {b:.2f} of the bound, covered {100 * c:.0f} % of {n}"
                    for a, b, c, n in zip(rmse, ratio, covered, stated, strict=True)
                ]
                name = f"{move.__name__} | {sigma:g} | {method}"
                times = f"{np.median(took):.2f} | {100 * np.mean(inside):.0f} %"
                print(f"| {name} | {' | '.join(cells)} | {times} |", flush=True)


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "five minutes",
        Size("runs", 60, 2, "records of each stick, with gusts and without"),
        Size("window", 20.0, 20.0, "of frequency-response [s]"),
    )
    main(options.runs, options.window)
