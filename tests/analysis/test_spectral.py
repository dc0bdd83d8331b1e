"""Frequency responses of records: SciPy's numbers, several inputs, feedback."""

import numpy as np
import pytest
import scipy.signal

from heli_jax.analysis.responses import TooFewAveragesError, responses
from heli_jax.analysis.spectra import cross_spectra

DT = 0.02
BAND = 2.0 * np.pi * np.arange(4, 60) / 20.0
"""Multiples of 1/20 Hz, SciPy's frequencies for segments of 20 s [rad/s]."""
LAG = scipy.signal.cont2discrete(([2.0], [1.0, 2.0]), DT)


def low_pass(u: np.ndarray) -> np.ndarray:
    return scipy.signal.lfilter(LAG[0].ravel(), LAG[1], u)


def true_response(omega: np.ndarray) -> np.ndarray:
    return scipy.signal.freqz(LAG[0].ravel(), LAG[1], omega * DT)[1]


@pytest.fixture(scope="module")
def noise() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((3, 6000))


def test_spectra_and_coherence_are_those_of_scipy(noise):
    spectra = cross_spectra([noise], DT, BAND, 20.0)
    same = {"fs": 1 / DT, "nperseg": 1000, "noverlap": 500, "detrend": "constant"}
    for a, b in ((0, 0), (0, 1), (2, 1)):
        theirs = scipy.signal.csd(noise[a], noise[b], **same)[1][4:60]
        np.testing.assert_allclose(
            spectra.density[:, a, b], theirs, atol=1e-12 * np.max(np.abs(theirs))
        )
    theirs = scipy.signal.coherence(noise[0], noise[1], **same)[1][4:60]
    np.testing.assert_allclose(responses(spectra, [0], [1]).coherence[:, 0, 0], theirs, atol=1e-10)


def test_partial_coherence_is_that_of_what_the_others_leave():
    """Test against a projection segment by segment, as derived by Bendat and Piersol."""
    rng = np.random.default_rng(1)
    u = rng.standard_normal((2, 6000))
    u[1] += 0.5 * low_pass(u[0])
    y = low_pass(u[0]) + 0.3 * u[1] + 0.5 * rng.standard_normal(6000)
    record = np.stack([*u, y])
    found = responses(cross_spectra([record], DT, BAND, 20.0), [0, 1], [2])
    window = scipy.signal.get_window("hann", 1000)
    parts = np.stack([record[:, i : i + 1000] for i in range(0, 5001, 500)])
    parts = (parts - parts.mean(-1, keepdims=True)) * window
    X = parts @ np.exp(-1j * np.outer(np.arange(1000), BAND * DT))
    for k in range(0, BAND.size, 9):
        other, stick, answer = X[:, 1, k], X[:, 0, k], X[:, 2, k]
        left = [v - other * (np.vdot(other, v) / np.vdot(other, other)) for v in (stick, answer)]
        size = np.abs(np.vdot(*left)) ** 2
        expected = size / (np.vdot(left[0], left[0]) * np.vdot(left[1], left[1])).real
        assert found.coherence[k, 0, 0] == pytest.approx(expected, rel=1e-9)
        assert found.H[k, 0, 0] == pytest.approx(
            np.vdot(left[0], left[1]) / np.vdot(left[0], left[0]), rel=1e-9
        )


def test_inputs_that_move_together_are_told_apart_and_errors_are_as_large_as_stated():
    inside, bias = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((3, 9000))
        u[1] += 0.6 * u[0]
        u[2] -= 0.5 * u[1]
        true = np.stack([true_response(BAND), 0.5 * true_response(BAND), 0 * BAND])
        y = low_pass(u[0]) + 0.5 * low_pass(u[1]) + 0.2 * rng.standard_normal(9000)
        found = responses(cross_spectra([np.stack([*u, y])], DT, BAND, 20.0), [0, 1, 2], [3])
        error = (found.H[:, 0] - true.T) / found.sd[:, 0]
        inside.append(np.mean(np.abs(np.stack([error.real, error.imag])) < 1.96))
        bias.append(error)
    assert 0.92 < np.mean(inside) < 0.97
    # The mean over thirty records; bins 1/20 Hz apart in a Hann window are dependent.
    assert np.mean(np.abs(np.mean(bias, axis=0))) < 2.0 / np.sqrt(30)


def closed_loop(seed: int, n: int = 12000) -> np.ndarray:
    """Return stick, roll and sweep: the stick follows the roll, and gusts act on it."""
    rng = np.random.default_rng(seed)
    b, a = LAG[0].ravel(), LAG[1]
    sweep = low_pass(rng.standard_normal(n)) * 4.0
    gust = low_pass(rng.standard_normal(n)) * 4.0
    # y = G u + gust, u = sweep - 2 y of the previous sample, solved as one filter.
    y, u = np.zeros(n), np.zeros(n)
    x = 0.0
    for k in range(n):
        y[k] = x + gust[k]
        u[k] = sweep[k] - 2.0 * y[k]
        x = -a[1] * x + b[1] * u[k]
    return np.stack([u, y, sweep])


def test_feedback_biases_the_response_and_an_instrument_takes_the_bias_off():
    flights = [closed_loop(seed) for seed in range(10)]
    spectra = cross_spectra(flights, DT, BAND, 20.0)
    direct, by = responses(spectra, [0], [1]), responses(spectra, [0], [1], instruments=[2])
    true = true_response(BAND)
    size = np.abs(true)
    assert np.mean(np.abs(direct.H[:, 0, 0] - true) / size) > 0.2
    error = (by.H[:, 0, 0] - true) / by.sd[:, 0, 0]
    assert np.abs(np.mean((by.H[:, 0, 0] - true) / size)) < 0.05
    assert np.mean(np.abs(np.stack([error.real, error.imag])) < 1.96) > 0.88


def test_sticks_that_move_as_one_have_no_response_each(noise):
    record = np.stack([noise[0], 2.0 * noise[0], low_pass(noise[0])])
    found = responses(cross_spectra([record], DT, BAND, 10.0), [0, 1], [2])
    assert np.isnan(found.H).all()
    assert np.isnan(found.coherence).all()


@pytest.mark.parametrize("change", [{"seconds": 500.0}, {"omega": np.array([0.0, 1.0])}])
def test_what_no_segment_can_show_is_refused(noise, change):
    arguments = {"records": [noise], "dt": DT, "omega": BAND, "seconds": 20.0} | change
    with pytest.raises(ValueError):  # noqa: PT011
        cross_spectra(**arguments)


def test_too_few_averages_for_so_many_inputs_are_refused(noise):
    spectra = cross_spectra([noise], DT, BAND, 70.0)
    with pytest.raises(TooFewAveragesError):
        responses(spectra, [0, 1], [2])


def test_records_of_any_length_are_averaged_by_their_segments(noise):
    long, short = noise[:, :4000], noise[:, 4000:5500]
    whole = cross_spectra([long, short, noise[:, 5900:]], DT, BAND, 20.0)
    parts = [cross_spectra([r], DT, BAND, 20.0) for r in (long, short)]
    expected = (7 * parts[0].density + 2 * parts[1].density) / 9
    np.testing.assert_allclose(whole.density, expected, rtol=1e-12)
    assert whole.averages == pytest.approx(parts[0].averages + parts[1].averages)
