"""Which measured frequency responses a model is to be fitted to."""

from typing import NamedTuple


class PairOptions(NamedTuple):
    """One response that takes part, where not all do."""

    input: str
    output: str
    band: tuple[float, float] | None = None
    """[Hz]; None: that of all"""
    coherence: float | None = None
    """least partial coherence; None: that of all"""


class ResponseOptions(NamedTuple):
    """Frequencies, windows, and the responses that take part."""

    band: tuple[float, float] | None = None
    """first and last frequency [Hz]; None: a period in a window to 0.4 of the rate"""
    window: float | None = None
    """length [s]; None: a fifth of the longest flight, 30 s at most"""
    points: int | None = None
    """frequencies about equally spaced in the logarithm; None: all lines of the window"""
    coherence: float = 0.0
    """least partial coherence in the mean over an octave; 0 leaves all to their weights"""
    pairs: tuple[PairOptions, ...] = ()
    """those that take part; all where none is named"""
