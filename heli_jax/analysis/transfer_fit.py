"""Transfer functions with a delay, fitted to one measured frequency response.

Complex linear errors are weighted by the random error of each frequency, since logarithmic errors
(CIFER) are biased at low coherence. Frequencies that one window cannot resolve share their
information, so that intervals do not depend on the density of points.

Sources: Sanathanan and Koerner (1963) for the start; Pintelon and Schoukens (2012), chapter 9, for
the weights and the covariance; Tischler and Remple (2012), chapter 11, for the cost J.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from heli_jax.analysis.responses import independent_shares, student95

_ROUNDS = 12
"""Rounds of Sanathanan and Koerner's iteration, which converges within about five."""
_DELAYS = 13
"""Number of start delays. The phase wraps, and each wrap has an optimum."""
_SEARCHES = 3
"""Number of starts that are optimised."""
_AS_LIKELY = 10.8
"""Largest chance difference between two optima in squared errors over variance (99.9 %, one degree
of freedom).
"""
_SINGULAR = 1e-10
"""Singular value of the Jacobian below which a coefficient is not determined [fraction of the
largest].
"""
_IMAGES = 50
"""Number of images on either side; their shares fall with the square of the index."""
_FAR = 10.0
"""Relative sd above which a coefficient is unknown. In mid-band units, denominator coefficients and
the delay's phase are of order 1.
"""


class Coefficient(NamedTuple):
    """A coefficient of a transfer function."""

    value: float
    sd: float
    """Standard deviation; inf if the response does not determine the coefficient."""
    lower95: float
    upper95: float

    @property
    def determined(self) -> bool:
        """True if the response determines the coefficient."""
        return bool(np.isfinite(self.sd))


class TransferFit(NamedTuple):
    """(b_m s^m + ... + b_0) / (s^n + a_{n-1} s^{n-1} + ... + a_0) exp(-delay s)."""

    numerator: tuple[Coefficient, ...]
    """Numerator, highest power first."""
    denominator: tuple[Coefficient, ...]
    """Denominator, highest power first, without the leading 1."""
    delay: Coefficient | None
    """Delay [s]; None if not requested."""
    chi_squared: float
    """Squared errors over their variance, per degree of freedom. It is near 1 if the order suffices
    and the vehicle is linear.
    """
    J: float
    """Tischler's cost: below 100 is usual for a good fit, below 50 for one as good as flight data.
    """
    converged: bool

    @property
    def determined(self) -> bool:
        """True if the response determines all denominator coefficients and at least one of the
        numerator.
        """
        return all(c.determined for c in self.denominator) and any(
            c.determined for c in self.numerator
        )

    @property
    def poles(self) -> np.ndarray:
        """Poles (n,), complex [1/s]."""
        return np.roots([1.0, *(c.value for c in self.denominator)])

    @property
    def zeros(self) -> np.ndarray:
        """Zeros (m,), complex [1/s]."""
        return np.roots([c.value for c in self.numerator])

    def sampled(self, omega: Float[np.ndarray, " k"], hold: "Hold | None") -> np.ndarray:
        """Return the response of a sampled record (k,), complex.

        Args:
            omega: frequencies (k,) [rad/s].
            hold: hold of the input between samples; None gives G(i omega).
        """
        at, share = images(omega, hold)
        return np.sum(share * self.response(at), axis=1)

    def response(self, omega: Float[np.ndarray, "..."]) -> Complex[np.ndarray, "..."]:
        """Return G(i omega).

        Args:
            omega: frequencies of any shape [rad/s].
        """
        s = 1j * omega
        tau = 0.0 if self.delay is None else self.delay.value
        num = np.polyval([c.value for c in self.numerator], s)
        return num / np.polyval([1.0, *(c.value for c in self.denominator)], s) * np.exp(-s * tau)


class Measured(NamedTuple):
    """A measured response; arrays (k,)."""

    omega: np.ndarray
    """Frequencies [rad/s], rising."""
    H: np.ndarray
    """Response, complex."""
    sd: np.ndarray
    """Standard deviation of the real and of the imaginary part."""
    seconds: float
    """Length of the windows [s]."""
    coherence: np.ndarray
    hold: "Hold | None" = None
    """Hold of the input between samples; None for a continuous-time response."""
    freedom: float = np.inf
    """Degrees of freedom of the variances."""


class Hold(NamedTuple):
    """Hold of an input between its samples."""

    kind: str
    """"zero-order" or "linear"."""
    dt: float
    """Sample time [s]."""


def images(omega: Float[np.ndarray, " k"], hold: Hold | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the frequencies (k, M) that a sampled record shows at omega, and the share of each.

    Samples cannot distinguish a frequency from its images. A held input has power at all of them,
    which falls with their distance.

    Args:
        omega: frequencies (k,) [rad/s].
        hold: hold of the input; None for a continuous-time response, which has no images.
    """
    if hold is None:
        return omega[:, None], np.ones((omega.size, 1), complex)
    angle = omega[:, None] * hold.dt
    turned = angle + 2.0 * np.pi * np.arange(-_IMAGES, _IMAGES + 1)
    if hold.kind == "linear":
        share = 2.0 * (1.0 - np.cos(angle)) / turned**2 + 0j
    else:
        share = (1.0 - np.exp(-1j * angle)) / (1j * turned)
    return turned / hold.dt, share


class _Scaled(NamedTuple):
    """The response in a time unit that scales all coefficients to similar size."""

    s: np.ndarray
    """i omega over `speed` (k,)."""
    images: np.ndarray
    """i times the image frequencies over `speed` (k, M)."""
    share: np.ndarray
    """Shares of the images (k, M)."""
    H: np.ndarray
    weight: np.ndarray
    """Weight (k,) of a complex error: square root of the information of its real part."""
    speed: float
    """Unit of frequency [rad/s]."""


def fit_transfer(measured: Measured, zeros: int, poles: int, delay: bool = True) -> TransferFit:
    """Fit a transfer function by least squares.

    Args:
        measured: the response; frequencies with values that are not finite are left out.
        zeros: order m of the numerator, at most n.
        poles: order n of the denominator, from 1 to 8.

    Raises:
        ValueError: orders out of range, or too few frequencies for the number of coefficients.
    """
    if not (1 <= poles <= 8 and 0 <= zeros <= poles):
        raise ValueError(
            f"expected 1 to 8 poles and at most as many zeros, got {poles} poles and {zeros} zeros"
        )
    scaled = _scaled(measured)
    unknowns = zeros + 1 + poles + delay
    if 2.0 * np.sum(_shares(measured)) <= unknowns:
        raise ValueError(
            f"expected more than {unknowns / 2:g} independent frequencies for {unknowns} "
            f"coefficients, got {np.sum(_shares(measured)):.3g}: a wider band or longer windows, "
            "fewer zeros and poles, or a lower limit of coherence"
        )
    begun = [_begin(scaled, zeros, poles, tau) for tau in _first_delays(scaled, delay)]
    # Only the best starts are optimised, since one search costs as much as all starts.
    begun.sort(key=lambda x: _cost(scaled, x, zeros))
    best = min((_search(scaled, x, zeros, delay) for x in begun[:_SEARCHES]), key=lambda r: r.cost)
    freedom = _freedom(measured, best.x.size)
    best = _stable(scaled, best, zeros, freedom) if delay else best
    return _result(measured, scaled, best, zeros, delay, freedom)


def _shares(m: Measured) -> np.ndarray:
    """Return the share (k,) of an independent frequency that each frequency has."""
    sound = np.isfinite(m.H) & np.isfinite(m.sd) & (m.sd > 0)
    return np.where(sound, independent_shares(m.omega, m.seconds), 0.0)


def _scaled(m: Measured) -> _Scaled:
    share = _shares(m)
    kept = share > 0
    speed = float(np.exp(np.mean(np.log(m.omega[kept])))) if kept.any() else 1.0
    weight = np.sqrt(share[kept]) / m.sd[kept]
    at, share = images(m.omega[kept], m.hold)
    return _Scaled(1j * m.omega[kept] / speed, 1j * at / speed, share, m.H[kept], weight, speed)


def _first_delays(scaled: _Scaled, delay: bool) -> np.ndarray:
    # Up to one turn of the phase at the highest frequency. Negative delays too, since a log may
    # record a stick after it acted.
    turns = np.linspace(-0.5, 1.0, _DELAYS)
    return turns * 2.0 * np.pi / np.abs(scaled.s[-1]) if delay else np.zeros(1)


def _begin(scaled: _Scaled, zeros: int, poles: int, tau: float) -> np.ndarray:
    """Compute coefficients by linear least squares, weighted by the denominator of the round
    before.
    """
    # The frequency itself has almost the whole share of its images.
    own = scaled.share[:, scaled.share.shape[1] // 2]
    s, H = scaled.s, scaled.H / own * np.exp(scaled.s * tau)
    up, down = np.vander(s, zeros + 1), np.vander(s, poles)
    weight, x = scaled.weight, np.zeros(zeros + 1 + poles)
    for _ in range(_ROUNDS):
        A = weight[:, None] * np.concatenate([up, -H[:, None] * down], axis=1)
        b = weight * H * s**poles
        x = np.linalg.lstsq(_rows(A), _rows(b), rcond=None)[0]
        below = np.abs(s**poles + down @ x[zeros + 1 :])
        weight = scaled.weight / np.maximum(below, 1e-9 * np.max(below))
    return np.concatenate([x, [tau]])


def _rows(v: np.ndarray) -> np.ndarray:
    """Stack complex rows as twice as many real ones."""
    return np.concatenate([np.real(v), np.imag(v)], axis=0)


def _model(scaled: _Scaled, x: np.ndarray, zeros: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the response (k,) and its derivatives (k, unknowns); the last unknown is the delay."""
    s, poles = scaled.images, x.size - zeros - 2
    powers = np.vander(s.ravel(), poles + 1).reshape(*s.shape, poles + 1)
    up, down = powers[..., poles - zeros :], powers[..., 1:]
    below = powers[..., 0] + down @ x[zeros + 1 : -1]
    turned = np.exp(-s * x[-1]) / below
    G = (up @ x[: zeros + 1]) * turned
    derivatives = [up * turned[..., None], -down * (G / below)[..., None], (-s * G)[..., None]]
    share = scaled.share[..., None]
    return np.sum(scaled.share * G, axis=1), np.sum(share * np.concatenate(derivatives, 2), axis=1)


def _cost(scaled: _Scaled, x: np.ndarray, zeros: int) -> float:
    """Return the sum of squared rows; infinite for a start that is not finite."""
    with np.errstate(all="ignore"):
        error = scaled.weight * (_model(scaled, x, zeros)[0] - scaled.H)
        cost = float(np.sum(np.abs(error) ** 2))
    return cost if np.isfinite(cost) else np.inf


# Any: SciPy's OptimizeResult has no types.
def _search(scaled: _Scaled, x: np.ndarray, zeros: int, delay: bool):
    # Local import: SciPy's optimiser takes a third of a second, and few commands need it.
    from scipy.optimize import least_squares

    kept = x.size if delay else x.size - 1

    def whole(part: np.ndarray) -> np.ndarray:
        return np.concatenate([part, x[kept:]])

    def residuals(part: np.ndarray) -> np.ndarray:
        return _rows(scaled.weight * (_model(scaled, whole(part), zeros)[0] - scaled.H))

    def jacobian(part: np.ndarray) -> np.ndarray:
        derivatives = _model(scaled, whole(part), zeros)[1]
        return _rows(scaled.weight[:, None] * derivatives)[:, :kept]

    with np.errstate(all="ignore"):
        return least_squares(
            residuals,
            x[:kept],
            jacobian,  # pyright: ignore[reportArgumentType]
            method="lm",
            x_scale="jac",
            max_nfev=400,
        )


def _freedom(measured: Measured, unknowns: int) -> float:
    """Return the degrees of freedom, at least 1."""
    return max(2.0 * float(np.sum(_shares(measured))) - unknowns, 1.0)


def _stable(scaled: _Scaled, best, zeros: int, freedom: float):
    """Reflect fast unstable poles of the optimum, unless the data prefer them.

    In the band, 1 / (p - s) is nearly 1 / (p + s) with a delay shorter by 2 / p. So the stable pole
    is assumed without strong evidence. Slow poles in the band stay.
    """
    poles = _roots(best, zeros)
    growing = _fast_growing(poles)
    if not growing.any():
        return best
    x = best.x.copy()
    x[: zeros + 1] *= (-1.0) ** np.sum(growing)
    x[zeros + 1 : -1] = np.real(np.poly(np.where(growing, -np.conj(poles), poles)))[1:]
    x[-1] -= np.sum(np.real(2.0 / poles[growing]))
    other = _search(scaled, x, zeros, True)
    allowed = _AS_LIKELY * max(2.0 * float(best.cost) / freedom, 1.0)
    as_likely = 2.0 * float(other.cost - best.cost) <= allowed
    fewer = np.sum(_fast_growing(_roots(other, zeros))) < np.sum(growing)
    return other if as_likely and fewer else best


def _roots(optimum, zeros: int) -> np.ndarray:
    """Return the poles (n,) in units of the mid-band frequency."""
    return np.roots(np.concatenate([[1.0], optimum.x[zeros + 1 : -1]]))


def _fast_growing(poles: np.ndarray) -> np.ndarray:
    return (np.real(poles) > 0) & (np.abs(poles) > 1.0)


def _result(
    measured: Measured, scaled: _Scaled, optimum, zeros: int, delay: bool, freedom: float
) -> TransferFit:
    poles = optimum.x.size - zeros - 1 - delay
    # Convert to seconds: each power of s less in a coefficient is one power of the scale more.
    powers = np.concatenate(
        [poles - np.arange(zeros, -1, -1), poles - np.arange(poles - 1, -1, -1), [-1] * delay]
    )
    units = scaled.speed ** powers.astype(float)
    chi_squared = 2.0 * float(optimum.cost) / freedom
    # The unexplained error of the order is at least the measurement error.
    sd = _deviations(optimum.jac) * max(chi_squared, 1.0) ** 0.5
    size = np.ones(optimum.x.size)
    size[: zeros + 1] = np.max(np.abs(scaled.H))
    sd = np.where(sd > _FAR * np.maximum(np.abs(optimum.x), size), np.inf, sd)
    half = float(student95(np.asarray(measured.freedom)))
    values = [
        Coefficient(v, d, v - half * d, v + half * d)
        for v, d in zip((optimum.x * units).tolist(), (sd * units).tolist(), strict=True)
    ]
    whole = TransferFit(
        tuple(values[: zeros + 1]),
        tuple(values[zeros + 1 : zeros + 1 + poles]),
        values[-1] if delay else None,
        chi_squared,
        0.0,
        bool(optimum.status > 0),
    )
    return whole._replace(J=mismatch(measured, whole.sampled(measured.omega, measured.hold)))


def _deviations(J: np.ndarray) -> np.ndarray:
    """Return the sd of each unknown; inf if the rows do not determine it."""
    size = np.linalg.norm(J, axis=0)
    if not (np.isfinite(J).all() and np.all(size > 0)):
        return np.full(J.shape[1], np.inf)
    _, s, V = np.linalg.svd(J / size, full_matrices=False)
    lost = s <= _SINGULAR * s[0]
    with np.errstate(all="ignore"):
        variance = np.sum((V / np.where(lost, 1.0, s)[:, None]) ** 2, axis=0)
    undetermined = np.any(np.abs(V[lost]) > 1e-6, axis=0)
    return np.where(undetermined, np.inf, np.sqrt(variance)) / size


def mismatch(measured: Measured, model: Complex[np.ndarray, " k"]) -> float:
    """Return Tischler's cost J: 20 times the mean squared error in dB and degrees, weighted by
    coherence.

    It is NaN where nothing is measured. Source: Tischler and Remple (2012), section 11.2.
    """
    seen = np.isfinite(measured.H) & (np.abs(measured.H) > 0) & np.isfinite(measured.coherence)
    if not seen.any():
        return float("nan")
    quotient = model[seen] / measured.H[seen]
    weight = (1.58 * (1.0 - np.exp(-measured.coherence[seen]))) ** 2
    decibels = 20.0 * np.log10(np.maximum(np.abs(quotient), 1e-300))
    degrees = np.degrees(np.angle(quotient))
    # A squared degree weighs as 0.01745 squared dB: 7.57 dB and one radian count the same.
    return float(20.0 * np.mean(weight * (decibels**2 + 0.01745 * degrees**2)))
