"""The windows without overlap that together say most: greedy choice by the D-criterion."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.identification.identifiability.expected import expected_sd, together
from heli_jax.identification.identifiability.verdict import Unknown

ENOUGH = 0.9
"""D-efficiency of the windows that are taken: the q-th root of the determinant of their information
over that of all windows, about the part of all that is known of a parameter"""
DETERMINES = 1.0
"""relative sd below which a parameter counts as determined: a factor of e either way"""


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """One window of a flight."""

    flight: int
    """its number among the flights that are fitted"""
    label: str
    first: int
    last: int
    """samples from `first` up to but not including `last`"""
    start: float
    end: float
    """[s] from the beginning of the flight"""
    sd: Float[np.ndarray, " q"]
    """expected by this window alone, relative; inf where it does not determine a parameter"""
    excluded: str = ""
    """why it is not to be used"""

    def overlaps(self, other: "Window") -> bool:
        """Whether both have samples in common."""
        return self.flight == other.flight and self.first < other.last and other.first < self.last


class Choice(NamedTuple):
    """A window that was taken."""

    window: Window
    efficiency: float
    """D-efficiency of all that are taken up to it"""
    sd: Float[np.ndarray, " q"]
    """expected by all that are taken up to it"""
    reason: str


def chosen(
    unknowns: tuple[Unknown, ...],
    windows: list[Window],
    triangles: list[np.ndarray],
    usable: list[int],
    unknown: np.ndarray,
) -> tuple[tuple[Choice, ...], np.ndarray]:
    """Windows without overlap, the one that gains most first, until they say enough (Mehra, 1974),
    and the triangle of all that could be taken.

    Args:
        unknowns: the parameters.
        windows: all of them.
        triangles: what each says.
        usable: the numbers of those that may be taken.
        unknown: (q,) whether the whole record does not determine a parameter.
    """
    size = triangles[0].shape[0]
    begin = np.zeros((size, size))
    order, left, R = [], list(usable), begin
    steps = []
    while left:
        # The first of equal ones: the same record gives the same windows.
        gains = [_log_det(unknowns, together(R, triangles[k])) for k in left]
        best = left[int(np.argmax(gains))]
        R = together(R, triangles[best])
        order.append(best)
        steps.append((R, max(gains)))
        left = [k for k in left if not windows[k].overlaps(windows[best])]
    q, total = len(unknowns), steps[-1][1]
    taken, sd = [], np.full(q, np.inf)
    for k, (R, log_det) in zip(order, steps, strict=True):
        efficiency = float(np.exp((log_det - total) / q))
        after = np.where(unknown, np.inf, expected_sd(unknowns, R))
        taken.append(Choice(windows[k], efficiency, after, _reason(unknowns, sd, after)))
        sd = after
        if efficiency >= ENOUGH:
            break
    return tuple(taken), steps[-1][0]


def _log_det(unknowns: tuple[Unknown, ...], R: np.ndarray) -> float:
    """Logarithm of the determinant of what is known of the parameters of interest."""
    q = len(unknowns)
    # What nothing tells yet has the sd of its interval or of a factor of e, so that the determinant
    # is never zero; of the noise's own unknowns, which are eliminated, that is an sd of ten.
    weak = np.diag([max(u.prior, 1.0 / u.scale) for u in unknowns] + [0.1] * (len(R) - q))
    whole = np.linalg.qr(np.vstack([R, weak]), mode="r")
    # With the parameters last their corner of the triangle is what is left without the others.
    whole = np.linalg.qr(np.hstack([whole[:, q:], whole[:, :q]]), mode="r")
    corner = np.abs(np.diag(whole)[len(R) - q :])
    return 2.0 * float(np.sum(np.log(np.maximum(corner, 1e-300))))


def _reason(unknowns: tuple[Unknown, ...], before: np.ndarray, after: np.ndarray) -> str:
    """Of which parameter a window told most."""
    with np.errstate(invalid="ignore", divide="ignore"):
        fall = np.where(np.isfinite(after), np.log(before / after), 0.0)
    fall = np.nan_to_num(fall, nan=0.0, posinf=np.inf)
    known, new = after < DETERMINES, (after < DETERMINES) & (before >= DETERMINES)
    if not known.any():
        return "determines no parameter by itself"
    if new.any():
        return f"determines {', '.join(u.name for u, n in zip(unknowns, new, strict=True) if n)}"
    i = int(np.argmax(fall))
    return f"{unknowns[i].name}: sd {100 * before[i]:.2g} % to {100 * after[i]:.2g} %"
