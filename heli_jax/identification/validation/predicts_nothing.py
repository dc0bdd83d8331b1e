"""Does a filter predict anything of an output, beyond what its mean or the last sample says?"""

from collections.abc import Sequence

import numpy as np

BETTER = 0.8
"""share of the squared error of the mean, or of the sample before, that a prediction may leave at
most: more is what smoothing a noisy signal leaves without any model"""


def predicts_nothing(flights: Sequence[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Whether predictions one step ahead are hardly better than the mean of the flight, or than the
    sample before (persistence).

    Args:
        flights: by flight the measured output (N,) and the errors of its prediction (N,), SI, NaN
            where nothing was measured.
    """
    left, mean, before = 0.0, 0.0, 0.0
    for measured, error in flights:
        y, error = np.asarray(measured), np.asarray(error)
        # A sample is foretold by the one before only where both were measured.
        both = np.isfinite(y[1:]) & np.isfinite(y[:-1])
        if both.any():
            left += float(np.sum(error[1:][both] ** 2))
            mean += float(np.sum((y[1:][both] - np.nanmean(y)) ** 2))
            before += float(np.sum(np.diff(y)[both] ** 2))
    return left > BETTER * min(mean, before) > 0.0
