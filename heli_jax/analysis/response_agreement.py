"""Agreement of a model's frequency responses with measured ones: chi-squared, and Tischler's J."""

from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Bool, Complex, Float

from heli_jax.analysis.spectra import COHERENT, Windowed, octave_mean

USUAL_J = 100.0
"""Largest J of a response usually called acceptable (Tischler and Remple, 2012, chapter 11)."""
_POINTS = 20
"""Usual number of frequencies for J, equally spaced in the logarithm."""
_MISFIT = 2.0
"""Ratio of squared errors to those expected from random errors at which the model is doubted."""


class PairAgreement(NamedTuple):
    """Agreement of one response."""

    input: str
    output: str
    low: float
    high: float
    """First and last frequency used [Hz]; NaN if none is."""
    lines: int
    """Number of frequencies used."""
    of: int
    """Number of frequencies in the band."""
    coherence: float
    """Mean partial coherence over the frequencies used."""
    J: float
    """Tischler's cost over about twenty frequencies with a mean coherence of 0.6 over an octave;
    NaN if there are none.
    """
    chi_squared: float
    """Mean of squared errors over their variance; 1 is expected."""
    of_none: float
    """The same for a model without response: the measured response relative to its errors."""


APART = (
    "Too few windows hold all outputs to estimate the correlation of their errors. The errors "
    "are taken as independent; if they are not, intervals are too narrow. Use a shorter window."
)


class ResponseAgreement(NamedTuple):
    """Agreement of all responses together."""

    pairs: tuple[PairAgreement, ...]
    chi_squared: float
    """Squared errors per degree of freedom, over all outputs and inputs."""
    lower95: float
    upper95: float
    """95 % interval of chi_squared expected from random errors."""
    freedom: float
    """Degrees of freedom: independent values minus unknowns."""
    window: float
    """Length of a window [s]."""
    averages: tuple[tuple[str, float], ...]
    """Number of independent averages, by output."""
    instruments: tuple[str, ...]
    """Inputs whose responses use a logged excitation."""
    notes: tuple[str, ...]

    @property
    def outside(self) -> bool:
        """True if chi-squared lies outside its interval."""
        return self.chi_squared < self.lower95 or self.chi_squared > self.upper95

    @property
    def doubted(self) -> bool:
        """True if the model does not explain the responses."""
        return self.chi_squared > max(self.upper95, _MISFIT)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on responses that are not compared."""
        words = list(self.notes)
        left = [f"{p.input} to {p.output}" for p in self.pairs if not p.lines]
        if left:
            words.append(f"Responses that are not used: {', '.join(left)}.")
        some = sum(p.of - p.lines for p in self.pairs if p.lines)
        if some:
            total = sum(p.of for p in self.pairs if p.lines)
            words.append(
                f"{some} of {total} lines of the responses are not used: outside of a band or "
                "below a coherence."
            )
        return tuple(words)


def pair_agreements(
    w: Windowed,
    used: Bool[np.ndarray, "k p m"],
    H: Complex[np.ndarray, "k p m"],
    E: Complex[np.ndarray, "k p m"],
    variance: Float[np.ndarray, "k p m"],
    coherence: Float[np.ndarray, "k p m"],
) -> tuple[PairAgreement, ...]:
    """Return the agreement of each response."""
    out = []
    for j, output in enumerate(w.outputs):
        for i, input in enumerate(w.inputs):
            at = used[:, j, i]
            some = bool(at.any())
            hz = w.hz[at]
            errors, sizes = (np.abs(v[at, j, i]) ** 2 / variance[at, j, i] for v in (E, H))
            out.append(
                PairAgreement(
                    input,
                    output,
                    float(hz[0]) if some else np.nan,
                    float(hz[-1]) if some else np.nan,
                    int(at.sum()),
                    int(at.size),
                    float(np.mean(coherence[at, j, i])) if some else np.nan,
                    _J(w, at, (H[:, j, i], E[:, j, i], coherence[:, j, i])),
                    float(np.mean(errors)) if some else np.nan,
                    float(np.mean(sizes)) if some else np.nan,
                )
            )
    return tuple(out)


def _J(w: Windowed, used: np.ndarray, of_pair: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
    """Return J over frequencies about equally spaced in the logarithm, where the response is
    coherent.

    Errors of noise in decibels are unbounded.
    """
    # Local import: SciPy's optimiser takes longer to import than this function to run.
    from heli_jax.analysis.transfer_fit import Measured, mismatch

    used = used & (octave_mean(2.0 * np.pi * w.hz, of_pair[2]) >= COHERENT)
    if not used.any():
        return float("nan")
    hz = w.hz[used]
    spaced = np.geomspace(hz[0], hz[-1], _POINTS)
    at = np.unique(np.argmin(np.abs(np.log(hz[:, None] / spaced)), axis=0))
    H, E, coherence = (v[used][at] for v in of_pair)
    omega = 2.0 * np.pi * hz[at]
    return mismatch(Measured(omega, H, np.abs(H), w.seconds, coherence), H - E)


def expected_interval(freedom: float, of_noise: float) -> tuple[float, float]:
    """Return the 95 % interval of chi-squared over its degrees of freedom, from Fisher's F.

    The noise was estimated from the residual of the responses.
    """
    low, high = scipy.special.fdtri(freedom, max(of_noise, 1.0), np.array([0.025, 0.975]))
    return float(low), float(high)
