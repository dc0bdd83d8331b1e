"""Frequency responses as smooth curves with errors: from measurement or from a model.

Both give gain and phase at any frequency, and their derivatives by their sources of error: the
random errors of bins, or the parameters of a fit with their covariance.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.spectra import COHERENT, octave_mean
from heli_jax.analysis.transfer_fit import Hold, images
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model

_HALF_OCTAVE = 0.5 * np.log(2.0)
"""Half-width of a local fit to a measured response [log frequency]."""
_PRECISE = 0.03
"""Relative random error of bins at which the half-width starts to grow, up to an octave."""
_LEAST_BINS = 7
"""Least number of bins in a local fit, which widens if there are fewer."""
_SHARP, _SURELY = 0.2, 4.0
"""Deviation of two adjacent bins from their local fits that indicates a sharper response [relative
or rad; sd].
"""
_AROUND = 3
"""Number of bins to either side that give the expected phase of a bin."""


class Point(NamedTuple):
    """A response at k frequencies, with derivatives by q independent errors of unit variance."""

    log_gain: Float[np.ndarray, " k"]
    """Natural logarithm of the gain."""
    phase: Float[np.ndarray, " k"]
    """Phase [rad], on any branch."""
    gain_gradient: Float[np.ndarray, "k q"]
    """Derivative of the logarithm of the gain; NaN if no error is known."""
    phase_gradient: Float[np.ndarray, "k q"]
    """Derivative of the phase [rad]."""

    @property
    def response(self) -> Complex[np.ndarray, " k"]:
        """Response, complex."""
        return np.exp(self.log_gain + 1j * self.phase)

    @property
    def gain_sd(self) -> Float[np.ndarray, " k"]:
        """Standard deviation of the logarithm of the gain."""
        return np.linalg.norm(self.gain_gradient, axis=1)

    @property
    def phase_sd(self) -> Float[np.ndarray, " k"]:
        """Standard deviation of the phase [rad]."""
        return np.linalg.norm(self.phase_gradient, axis=1)


class Curve(NamedTuple):
    """A response at any frequency of a band."""

    at: Callable[[Float[np.ndarray, " k"]], Point]
    """Function of frequency [rad/s]."""
    band: tuple[float, float]
    """Band [rad/s]."""
    caution: str = ""
    """Frequencies at which the curve may differ from the response, in words."""


def integrated(curve: Curve) -> Curve:
    """Return the response of an angle, from that of its rate."""

    def at(omega: np.ndarray) -> Point:
        p = curve.at(omega)
        return p._replace(log_gain=p.log_gain - np.log(omega), phase=p.phase - 0.5 * np.pi)

    return curve._replace(at=at)


def times(curve: Curve, gain: float) -> Curve:
    """Return the response times a known gain, such as a loop's; a negative gain inverts it."""
    turned = np.pi if gain < 0 else 0.0

    def at(omega: np.ndarray) -> Point:
        p = curve.at(omega)
        return p._replace(log_gain=p.log_gain + np.log(abs(gain)), phase=p.phase + turned)

    return curve._replace(at=at)


def without_hold(
    omega: Float[np.ndarray, " k"], H: Complex[np.ndarray, " k"], hold: Hold
) -> Complex[np.ndarray, " k"]:
    """Return a sampled record's response without the hold of the input.

    Images about multiples of the rate remain, but are small for an attitude.
    """
    _, share = images(omega, hold)
    return H / share[:, share.shape[1] // 2]


def measured_curve(
    omega: Float[np.ndarray, " k"],
    H: Complex[np.ndarray, " k"],
    sd: Float[np.ndarray, " k"],
    coherence: Float[np.ndarray, " k"],
    window: float,
) -> Curve | str:
    """Fit local quadratics in logarithms to a measured response; return a reason if that fails.

    Gain and phase are fitted over half an octave to either side, or up to an octave if errors are
    large. Each bin is weighted by its random error. Errors of close bins are correlated;
    independent bins are 1.95 lines of the window apart. The band is the widest one with a mean
    coherence of 0.6 over an octave and no phase jump above a right angle. Beyond a larger jump the
    number of whole turns is unknown.

    Args:
        omega: frequencies (k,) [rad/s], rising.
        H: response (k,); NaN where unknown.
        sd: standard deviation (k,) of the real and of the imaginary part.
        coherence: partial coherence (k,).
        window: length of the Hann windows [s].
    """
    known = (octave_mean(omega, coherence) >= COHERENT) & np.isfinite(H) & (np.abs(H) > 0)
    coherent = _widest(np.log(omega), known)
    if coherent.size < _LEAST_BINS:
        if not coherent.size:
            return f"its mean coherence over an octave stays below {COHERENT}"
        return (
            f"{coherent.size} adjacent frequencies have a mean coherence of {COHERENT} over an "
            f"octave, expected at least {_LEAST_BINS}: more `points`, or more excitation"
        )
    # Beyond a bin that jumps, unwrapping may be wrong by a turn.
    known[coherent] &= ~_phase_jumps(H[coherent], sd[coherent])
    run = _widest(np.log(omega), known)
    if run.size < _LEAST_BINS:
        return "its phase jumps from bin to bin"
    w, H, relative = omega[run], H[run], sd[run] / np.abs(H[run])
    x = np.log(w)
    y = np.stack([np.log(np.abs(H)), np.unwrap(np.angle(H))], axis=1)
    root = _root(w, relative, window)

    def at(query: np.ndarray) -> Point:
        value = _local(x, np.log(query), relative)
        gradient, nothing = value @ root, np.zeros((query.size, run.size))
        # Gain and phase depend on different random numbers, since their errors are independent.
        log = value @ y
        return Point(
            log[:, 0],
            log[:, 1],
            np.concatenate([gradient, nothing], axis=1),
            np.concatenate([nothing, gradient], axis=1),
        )

    off = y - _local(x, x, relative) @ y
    return Curve(at, (float(w[0]), float(w[-1])), _too_sharp(w, np.max(np.abs(off), 1), relative))


def _too_sharp(w: np.ndarray, off: np.ndarray, relative: np.ndarray) -> str:
    """Return, in words, where a response (k,) differs from its local fits by more than random
    error.
    """
    far = (off > _SHARP) & (off > _SURELY * relative)
    both = np.flatnonzero(far[:-1] & far[1:])
    if not both.size:
        return ""
    hz = w[[both[0], both[-1] + 1]] / (2.0 * np.pi)
    return (
        f"caution: at {hz[0]:.3g} to {hz[1]:.3g} Hz the response is sharper than the half octave "
        "over which it is smoothed, as near a lightly damped mode (a slung load, a tail boom); "
        "values below w180 may be wrong: fit a model or a transfer function"
    )


def _phase_jumps(H: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return a mask of bins (k,) more than a right angle from the phase of their neighbours."""
    relative = sd / np.abs(H)
    # Weighted by the errors, but limited so that no single bin dominates. Its error may be too
    # small by chance.
    weights = 1.0 / (relative**2 + np.median(relative) ** 2)
    phasors = weights * H / np.abs(H)
    around = np.convolve(phasors, np.ones(2 * _AROUND + 1), mode="same") - phasors
    return np.real(H * np.conj(around)) < 0.0


def _widest(x: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the indices of the longest range of x without a gap."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    runs = [np.arange(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return max(runs, key=lambda r: x[r[-1]] - x[r[0]], default=np.zeros(0, int))


def _root(omega: np.ndarray, relative: np.ndarray, window: float) -> np.ndarray:
    """Return R (k, k), with R R' the covariance of the relative errors of the bins."""
    lines = (omega[:, None] - omega[None, :]) * window / (2.0 * np.pi)
    # Transform of the squared Hann window. Two bins share its square.
    shares = ((0.0, 3.0 / 8.0), (1.0, 0.25), (-1.0, 0.25), (2.0, 1.0 / 16.0), (-2.0, 1.0 / 16.0))
    shared = sum(c * np.sinc(lines - m) for m, c in shares) / (3.0 / 8.0)
    covariance = relative[:, None] * relative[None, :] * shared**2
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _local(x: np.ndarray, query: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Return rows (l, k) that map values at x to local quadratics at the queries."""
    d = x[None, :] - query[:, None]
    # The half-width grows with the errors, which minimises the mean squared error of local
    # quadratics.
    size = np.interp(query, x, octave_mean(np.exp(x), relative))
    reach = _HALF_OCTAVE * np.clip((size / _PRECISE) ** (2.0 / 7.0), 1.0, 2.0)
    reach = np.maximum(reach, 1.01 * np.sort(np.abs(d), axis=1)[:, _LEAST_BINS - 1])
    d = d / reach[:, None]
    # Weighted by the errors, but limited so that no single bin dominates.
    precise = 1.0 / (relative**2 + np.median(relative) ** 2)
    weights = np.maximum(1.0 - d**2, 0.0) ** 2 * precise
    X = np.stack([np.ones_like(d), d, d**2], axis=2)
    normal = np.einsum("lka,lk,lkb->lab", X, weights, X)
    return np.linalg.solve(normal, np.swapaxes(X * weights[:, :, None], 1, 2))[:, 0]


class LinearResponses(NamedTuple):
    """A model's matrices at a point, and their derivatives by q parameters.

    All are NumPy arrays; derivatives have the parameter as first axis.
    """

    model: Model
    matrices: tuple[np.ndarray, ...]
    """Matrices A, B, C, D."""
    derivatives: tuple[np.ndarray, ...]
    """Derivatives (q, ...) of each matrix."""
    delays: dict[str, tuple[float, np.ndarray]]
    """Delays of inputs [s], with derivatives (q,)."""


# Parameters, state and inputs are records of the model's own classes, hence Any.


def linear_responses(
    model: Model, params: Any, names: Sequence[str], state: Any = None, inputs: Any = None
) -> LinearResponses:
    """Return the model's matrices at a point with their derivatives by some parameters.

    The point is fixed. For a nonlinear model, its dependence on the parameters is neglected.

    Args:
        state: default: the model's initial state.
        inputs: default: zeros.
    """
    slopes, (matrices, delays) = jax.device_get(
        _with_slopes(model, params, tuple(names), state, inputs)
    )
    first = tuple(np.moveaxis(np.asarray(d), -1, 0) for d in slopes[0])
    by_input = {n: (float(v), np.asarray(slopes[1][n])) for n, v in delays.items()}
    return LinearResponses(model, tuple(np.asarray(M) for M in matrices), first, by_input)


@eqx.filter_jit
def _with_slopes(
    model: Model, params: Any, names: tuple[str, ...], state: Any, inputs: Any
) -> tuple[Any, Any]:
    """Return derivatives of matrices and delays by the named parameters, and both values."""
    late = dict(model.delays)

    def of(values: Array) -> tuple[Any, Any]:
        here = naming.replace(params, **dict(zip(names, values, strict=True)))
        delays = {n: jnp.asarray(getattr(here, p), float) for n, p in late.items()}
        both = tuple(jacobians(model, here, state, inputs)), delays
        return both, both

    values = [jnp.asarray(getattr(params, n), float) for n in names]
    return jax.jacfwd(of, has_aux=True)(jnp.stack(values) if values else jnp.zeros(0))


class Acting(NamedTuple):
    """Transfer function of an input's effect on the model, and its derivatives by q parameters."""

    gain: float = 1.0
    late: float = 0.0
    """Delay [s]."""
    by_gain: np.ndarray | None = None
    by_late: np.ndarray | None = None


def modelled_curve(
    of: LinearResponses,
    pair: tuple[str, str],
    root: Float[np.ndarray, "q r"],
    band: tuple[float, float],
    acting: Acting = Acting(),
) -> Curve:
    """Return a model's continuous response, with delays, and errors from those of its parameters.

    Args:
        root: R (q, r), with R R' the covariance of the parameters; NaN where unknown.
        band: first and last frequency [rad/s].
    """
    j = naming.names(of.model.Inputs).index(pair[0])
    i = naming.names(of.model.Outputs).index(pair[1])
    (A, B, C, D), (dA, dB, dC, dD) = of.matrices, of.derivatives
    q, zero = dA.shape[0], np.zeros(dA.shape[0])
    late, by_late = of.delays.get(pair[0], (0.0, zero))
    late = late + acting.late
    by_late = by_late + (zero if acting.by_late is None else acting.by_late)
    by_gain = zero if acting.by_gain is None else acting.by_gain / acting.gain
    # An unknown parameter matters only where the response depends on it.
    known = np.isfinite(root).all(axis=1)
    certain = np.where(known[:, None], root, 0.0)

    def gradient(by: np.ndarray) -> np.ndarray:
        open_ = np.any((np.abs(by) > 1e-12) & ~known[None, :], axis=1)
        return np.where(open_[:, None], np.nan, by @ certain)

    def at(omega: np.ndarray) -> Point:
        s = 1j * omega[:, None, None] * np.eye(A.shape[0])
        x = np.linalg.solve(s - A, B[None, :, j : j + 1].astype(complex))[:, :, 0]
        y = np.linalg.solve(s - A.T, C[i][None, :, None].astype(complex))[:, :, 0]
        H = x @ C[i] + D[i, j]
        by = np.einsum("km,qmn,kn->kq", y, dA, x, optimize=True) if q else np.zeros((omega.size, 0))
        by = by + x @ dC[:, i].T + y @ dB[:, :, j].T + dD[:, i, j]
        with np.errstate(all="ignore"):
            relative = by / H[:, None] + by_gain - 1j * omega[:, None] * by_late
            log = np.log(H * acting.gain) - 1j * omega * late
        return Point(log.real, log.imag, gradient(relative.real), gradient(relative.imag))

    return Curve(at, band)


# Envelopes: differences between modelled and measured response that pilots do not notice.

# Numerators and denominators in s, highest power first. For the phase, the value is the argument in
# degrees.
_GAIN = (((0.095, 9.92, 2.15), (1.0, 11.6, 4.95)), ((3.16, 31.61, 22.79), (1.0, 27.14, 1.84)))
_PHASE = (
    ((475.32, 184100.0, 29460.0), (1.0, 11.66, 0.039)),
    ((68.89, 1100.12, -275.22), (1.0, 39.94, 9.99)),
)


class Envelope(NamedTuple):
    """Lower and upper limits of measured over modelled response (k,)."""

    gain_db: tuple[np.ndarray, np.ndarray]
    phase_deg: tuple[np.ndarray, np.ndarray]


def unnoticeable(omega: Float[np.ndarray, " k"]) -> Envelope:
    """Return the envelopes of maximum unnoticeable added dynamics.

    Pilots of full-size fixed-wing aircraft did not notice added dynamics within them. They are
    narrowest at about 1 to 5 rad/s. They are for comparison only.

    Args:
        omega: frequencies (k,) [rad/s].

    Source: Wood and Hodgkinson (1980), Definition of acceptable levels of mismatch for equivalent
    systems of augmented CTOL aircraft, MDC A6792, as in MIL-STD-1797A and Tischler and Remple
    (2012). The coefficients are those of LoesBound by C. Regan (2006), which were not compared with
    the reports. Some sources add a lead and a lag of a few milliseconds to the phase envelopes.
    They are left out here, which gives narrower envelopes.
    """
    s = 1j * omega
    gain = [20.0 * np.log10(np.abs(np.polyval(n, s) / np.polyval(d, s))) for n, d in _GAIN]
    phase = [np.degrees(np.angle(np.polyval(n, s) / np.polyval(d, s))) for n, d in _PHASE]
    return Envelope((gain[0], gain[1]), (phase[0], phase[1]))
