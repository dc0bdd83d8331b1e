"""Does a measured output go against the simulated one, beside a disturbance?"""

import numpy as np

from heli_jax.identification.validation.advice import Record
from heli_jax.identification.validation.metrics import autocorrelation

_TURNED = -3.0
"""slope of the measured on the simulated output that no disturbance makes"""
_FIVE_PERCENT = -1.645
"""of a standard normal distribution, to one side"""


def moves_against(name: str, records: tuple[Record, ...]) -> bool:
    """Whether the measured output goes against a simulated one that has shrunk, not by chance.

    A disturbance knows nothing of the inputs. So the slope of the measured on the simulated output
    is 1 but for what chance makes of the two, whose autocorrelations say how much that is
    (Bartlett, 1935).
    """
    # Where an input has the wrong sign and the parameters keep theirs, the filter takes the
    # response for disturbance and the simulation shrinks: the slope is then several times below
    # -1. A slope that is merely negative tells nothing in a record of a few swings.
    product, power, variance = 0.0, 0.0, 0.0
    for r in records:
        if name not in r.measured or not np.isfinite(r.simulated[name]).all():
            continue
        covariance, own_power, chance = _covariance_by_chance(r.measured[name], r.simulated[name])
        product, power, variance = product + covariance, power + own_power, variance + chance
    if not (power > 0 and variance > 0):
        return False
    return 1.0 + product / power < _TURNED and product / variance**0.5 < _FIVE_PERCENT


def _covariance_by_chance(y: np.ndarray, m: np.ndarray) -> tuple[float, float, float]:
    """Of the disturbance's part d = y - m of an output: d'm, m'm, and the variance that d'm has
    where the two are independent."""
    # The slope of y on m is 1 + d'm / m'm.
    # Only where something was measured, for both: a slope over all of the simulation and a few
    # samples of the output would be none.
    seen = ~np.isnan(y)
    y, m = y[seen], m[seen]
    d, m = y - m - np.mean(y - m), m - m.mean()
    lags = max(1, y.size // 5)
    # Bartlett's window: without it the sum over the lags can be negative, and no variance.
    window = 1.0 - np.arange(lags + 1) / (lags + 1)
    both = window * autocorrelation(d, lags) * autocorrelation(m, lags)
    power = float(m @ m)
    chance = float(d @ d) * power * (both[0] + 2.0 * both[1:].sum()) / y.size
    return float(d @ m), power, chance
