"""Signals smoothed by a short kernel, with the derivatives of what is smoothed.

The kernel is w(s) = (1 - s^2)^4 over a few samples to either side, of unit area. A derivative is
taken of the kernel and not of the samples, by parts: (w * x)' = w' * x. That is the method of
modulating functions (M. Shinbrot, NACA TN 3288, 1954); it does what the local smoothing and
differentiation of SIDPAC's `smoo` and `deriv` do (V. Klein and E. A. Morelli, Aircraft System
Identification, 2006, ch. 11), and beyond that keeps a linear equation exact: x' = A x + B u holds
for smoothed states, derivatives and inputs as it does for themselves, however much is smoothed.
"""

import itertools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial

ORDERS = 3
"""a signal, its first and its second derivative"""
HALF_WIDTHS = (4, 6, 8, 12, 16, 24, 32, 48, 64)
"""of the kernel, in samples, of which one is taken"""
_MOST_LEFT_OUT = 0.05
"""part of a signal's motion that smoothing may take away beside the noise"""
_BRIDGED = 3
"""missing samples in a row that a straight line replaces; more end a segment"""
_LOST = 2.5
"""usual steps of a slow sensor that a cubic bridges: one lost sample, with jitter"""
_FEWEST = 8
"""samples of a slow sensor through which a cubic is drawn"""
# Of the fourth power the kernel and its first three derivatives vanish at the ends. Sums over
# samples are then close to the integrals that integration by parts is about, for all derivatives
# that are taken here, and the parts at the ends are zero.
_SHAPE = Polynomial([1.0, 0.0, -1.0]) ** 4
_AREA = float(_SHAPE.integ()(1.0) - _SHAPE.integ()(-1.0))


def margin(half: int) -> int:
    """Samples at either end of a segment that smoothing takes away."""
    return half + 2  # two more: a delayed and held input reaches further back


def smoothed(y: Float[np.ndarray, " N"], dt: float, half: int) -> Float[np.ndarray, "r n"]:
    """A sampled signal smoothed, and its derivatives.

    Args:
        y: the samples (N,), all seen.
        dt: time between them [s].
        half: half width of the kernel in samples.

    Returns:
        (3, N - 2 `margin`) the smoothed signal and its derivatives per second.
    """
    return _convolved(y, _of_samples(dt, half, 0.0))


def smoothed_input(
    u: Float[np.ndarray, " N"], dt: float, half: int, *, held: bool, late: float = 0.0
) -> Float[np.ndarray, "r n"]:
    """An input smoothed, and its derivatives, as `smoothed` gives them.

    Args:
        u: the samples (N,).
        dt: time between them [s].
        half: half width of the kernel in samples.
        held: whether it stays between samples; else it follows a straight line.
        late: how late it acts [s].
    """
    whole = int(np.floor(late / dt))
    rest = late / dt - whole
    # Whole samples of the delay by index, the rest of it within the weights: so a delay changes the
    # smoothed input without steps. Before the record the input is taken to be as at its beginning.
    shifted = u[np.clip(np.arange(u.size) - whole, 0, u.size - 1)]
    # A held input jumps. Weights at the samples would put each jump in the middle of an interval,
    # half a sample late or early, and the regression would find that as a delay.
    weights = _of_held(dt, half, rest) if held else _of_samples(dt, half, rest)
    return _convolved(shifted, weights)


def _convolved(
    x: Float[np.ndarray, " N"], weights: Float[np.ndarray, "r w"]
) -> Float[np.ndarray, "r n"]:
    # Only where the whole kernel lies within the samples: at the ends a kernel cut off would no
    # longer keep the equations exact.
    return np.stack([np.convolve(x, w, mode="valid") for w in weights])


def _of_samples(dt: float, half: int, rest: float) -> Float[np.ndarray, "r w"]:
    """Weights of the samples around one of them: the kernel and its derivatives there."""
    j = np.arange(-margin(half), margin(half) + 1) - rest
    weights = np.stack([_kernel(r, j / half) * half ** -(r + 1.0) for r in range(ORDERS)])
    # The sum over samples is not quite the integral. So that a constant stays one and has no
    # derivatives, and a line and a parabola have theirs, the weights are put right by the kernel.
    weights[0] /= weights[0].sum()
    # In this order: each later row is cleared of what the rows before it would make of it.
    weights[1] -= weights[1].sum() * weights[0]
    weights[1] /= -(weights[1] @ j)
    weights[2] -= weights[2].sum() * weights[0]
    weights[2] /= 0.5 * (weights[2] @ j**2)
    return weights / dt ** np.arange(ORDERS)[:, None]


def _of_held(dt: float, half: int, rest: float) -> Float[np.ndarray, "r w"]:
    """Weights of the samples of a held input: the kernel's integrals over each sample time."""
    j = np.arange(-margin(half), margin(half) + 1) - rest
    weights = [
        (_kernel(r - 1, j / half) - _kernel(r - 1, (j - 1.0) / half)) * half**-r
        for r in range(ORDERS)
    ]
    return np.stack(weights) / dt ** np.arange(ORDERS)[:, None]


def _kernel(order: int, s: np.ndarray) -> np.ndarray:
    """The kernel's derivative of that order by s; -1 for its integral from the left."""
    inside = np.clip(s, -1.0, 1.0)
    if order < 0:
        integral = _SHAPE.integ()
        return (integral(inside) - integral(-1.0)) / _AREA
    # Zero at the ends up to the third derivative, so clipping makes no step there.
    return _SHAPE.deriv(order)(inside) / _AREA if order else _SHAPE(inside) / _AREA


def half_width(outputs: Mapping[str, np.ndarray], sd: Mapping[str, float]) -> int:
    """The widest kernel that takes away little more than noise of every output.

    Args:
        outputs: whole segments of samples (N,) by name.
        sd: of their measurement noise.
    """
    best = HALF_WIDTHS[0]
    for half in HALF_WIDTHS:
        inner = slice(margin(half), -margin(half))
        for name, y in outputs.items():
            # A wide kernel takes half a width away at either end of every segment: a short record
            # would be left with little to regress.
            if y.size < 8 * half:
                return best
            left = float(np.std(y[inner] - smoothed(y, 1.0, half)[0]))
            # What smoothing takes away should be noise. A little of the motion may go as well, and
            # the two add as independent variances do.
            if left > np.hypot(sd[name], _MOST_LEFT_OUT * float(np.std(y))):
                return best
        best = half
    return best


def segments(outputs: Mapping[str, np.ndarray]) -> tuple[list[slice], dict[str, np.ndarray]]:
    """Where all outputs are seen, and the outputs with short gaps bridged by straight lines.

    Args:
        outputs: samples (N,) by name, NaN where one is missing.
    """
    bridged = {name: _bridged(y) for name, y in outputs.items()}
    seen = np.all([np.isfinite(y) for y in bridged.values()], axis=0)
    edges = np.flatnonzero(np.diff(np.r_[False, seen, False].astype(int)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)], bridged


def _bridged(y: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    seen = np.flatnonzero(np.isfinite(y))
    if seen.size < 2:
        return y
    # NaN outside: a line between two samples is a guess with two ends, beyond the last there is
    # none.
    usual, allowed = float(np.median(np.diff(seen))), _BRIDGED
    filled = np.interp(np.arange(y.size), seen, y[seen], left=np.nan, right=np.nan)
    if usual > _BRIDGED and seen.size >= _FEWEST:
        # A slow sensor on a fast grid: a cubic from sample to sample. What is regressed is then no
        # faster than it, which is enough to begin with; the fit itself sees the samples alone.
        from scipy.interpolate import CubicSpline

        inside = slice(int(seen[0]), int(seen[-1]) + 1)
        filled[inside] = CubicSpline(seen, y[seen])(np.arange(inside.start, inside.stop))
        allowed = _LOST * usual
    for before, after in itertools.pairwise(seen):
        if after - before - 1 > allowed:
            filled[before + 1 : after] = np.nan
    return filled
