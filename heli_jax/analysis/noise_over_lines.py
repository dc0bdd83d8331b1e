"""The noise of a response as a mean over frequencies, where one has few averages.

Of n averages a variance is known to the n - m degrees of freedom that m inputs leave, of two
averages to little more than its order of magnitude. Weights by such variances trust the
frequencies that happened to look quiet: of windows of half a record 72 % of a delay's 95 %
intervals held the truth.

Source: Pintelon and Schoukens (2012), section 9.4, for weights by estimated variances.
"""

import numpy as np
import scipy.special
from jaxtyping import Float

Z95 = 1.959963984540054
"""half of a 95 % interval in standard deviations that are known"""
_ENOUGH = 40.0
"""degrees of freedom of a variance from which on weights by it are as good as by the true one"""
RESOLVED = 1.95
"""frequencies closer than this over the window's length are not independent (Hann)"""
_TRIANGLE = 1.5
"""equal terms whose mean is as certain as one in a triangle of half this half-width"""


def independent_shares(omega: Float[np.ndarray, " k"], seconds: float) -> Float[np.ndarray, " k"]:
    """Of each frequency (k,) how much of an independent one it is.

    Args:
        omega: (k,) [rad/s], rising.
        seconds: length of the windows.
    """
    # Half of the way to each neighbour.
    width = np.gradient(omega) if omega.size > 1 else np.ones(1)
    return np.minimum(width * seconds / (2.0 * np.pi * RESOLVED), 1.0)


def averaged(
    noise: Float[np.ndarray, " k"], shares: Float[np.ndarray, " k"], averages: float
) -> tuple[Float[np.ndarray, " k"], float]:
    """A mean over as many independent frequencies as it takes, and its degrees of freedom.

    Args:
        noise: density (k,); NaN where it is not known.
        shares: (k,) how much of an independent frequency each is.
        averages: independent ones at each, less the inputs.
    """
    known = np.isfinite(noise) & (shares > 0)
    each = 2.0 * averages
    # Half-width of the triangle, in independent frequencies.
    reach = _ENOUGH / each / _TRIANGLE
    at = np.cumsum(shares) - 0.5 * shares
    near = np.maximum(1.0 - np.abs(at[:, None] - at[None, :]) / reach, 0.0) * np.where(
        known, shares, 0.0
    )
    with np.errstate(all="ignore"):
        mean = near @ np.where(known, noise, 0.0) / np.sum(near, axis=1)
    total = float(np.sum(shares[known]))
    freedom = each * max(min(_TRIANGLE * reach, total), 1.0)
    return np.where(known, mean, np.nan), freedom


def student95(freedom: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Half of a 95 % interval in standard deviations: Student's t.

    Args:
        freedom: degrees of freedom of the standard deviations, 1 at least; any shape.
    """
    return scipy.special.stdtrit(np.maximum(freedom, 1.0), 0.975)
