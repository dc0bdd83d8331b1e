"""What flights held out say of a fit in frequency: plain data, and in words."""

from typing import NamedTuple

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.finding import Finding, note
from heli_jax.numbers import number, p_value, percent, plain_words

LEVEL = 0.01
"""of the test whether a flight's own estimates are those of the fit"""

_DIGITS = 9


class HeldOutBand(NamedTuple):
    """Errors of one output in a band of frequencies, over all flights held out."""

    output: str
    low: float
    high: float
    """[Hz]"""
    chi_squared: float
    """squared errors over what the noise of the fitted flights lets expect; errors of the estimates
    are not allowed for"""
    lower95: float
    upper95: float
    """what the noise lets expect of it with 95 % probability"""


class Furthest(NamedTuple):
    """The parameter whose estimate in a flight is the furthest from that of the fit."""

    parameter: str
    own: float
    """what the flight says by itself: where it differs where steps of Gauss and Newton stay, else
    after the first from the fit [SI]"""
    fitted: float
    sds: float
    """joint standard deviations between the two"""

    @property
    def values(self) -> tuple[str, str]:
        """Both, with as many digits as tell them apart."""
        for digits in range(3, _DIGITS):
            both = (number(self.own, digits), number(self.fitted, digits))
            if both[0] != both[1]:
                break
        return plain_words(both[0]), plain_words(both[1])


class HeldOutFlight(NamedTuple):
    """A flight held out; of responses, those together that are too short by themselves."""

    flight: str
    chi_squared: float
    """squared errors over what the noise and the errors of the estimates let expect"""
    lower95: float
    upper95: float
    """what both let expect of it with 95 % probability"""
    freedom: float
    """independent real numbers that it is the mean of"""
    estimates_p_value: float | None
    """the chance that errors of both make the flight's own estimates as far from the fit's; null
    where it says nothing of them"""
    furthest: Furthest | None
    explained: dict[str, float]
    """by output, of the power that follows the excitation the part that the model explains; below 0
    it is worse than no model; of those alone where gusts leave at most 0.05 of it to chance"""
    worse: tuple[str, ...]
    """the outputs that a model without any response would explain better"""
    responses: ResponseAgreement | None
    """of a fit of frequency responses those of the flight, whose errors are compared with its own
    noise and not with that of the fitted flights"""

    @property
    def differs(self) -> bool:
        """Whether the flight speaks of other parameters."""
        return self.estimates_p_value is not None and self.estimates_p_value < LEVEL

    @property
    def in_words(self) -> str:
        """In a line: chi-squared, what was expected, the estimates, what is explained."""
        known = [f"chi-squared {self.chi_squared:.3g} ({self._expected})"]
        if self.estimates_p_value is not None:
            verb = "differ" if self.differs else "agree"
            known.append(f"its own estimates {verb} (p {p_value(self.estimates_p_value)})")
        if self.explained:
            parts = (
                f"{n} {plain_words(percent(v, 1)) if v >= 0 else 'none'}"
                for n, v in self.explained.items()
            )
            known.append(f"explained of what follows the excitation: {', '.join(parts)}")
        return "; ".join(known)

    @property
    def findings(self) -> list[Finding]:
        """What speaks against the fit, or keeps the flight from speaking for it."""
        where, found = f"{self.flight}, held out", []
        if self.worse:
            names = " and ".join(self.worse)
            words = f"{where}: of {names} the model explains less than no model at all would."
            brief = f"held out, the model is worse than none for {names}"
            found.append(
                Finding(
                    "held-out.worse-than-none",
                    "doubt",
                    words,
                    subjects=(self.flight, *self.worse),
                    brief=brief,
                    denies=True,
                )
            )
        if self.differs:
            found.append(self._differing)
        elif not self.worse and not self.lower95 <= self.chi_squared <= self.upper95:
            words, limit = f"{where}: {self._size}.", f"squared errors, {self._expected}"
            size = Finding("held-out.size", "note", words, self.chi_squared, limit, (self.flight,))
            found.append(size)
        return found

    @property
    def _differing(self) -> Finding:
        assert self.estimates_p_value is not None
        f, most, shifts = self.furthest, "", {}
        if f is not None:
            most = (
                f"; by itself {f.parameter} is the furthest, from {f.values[1]} to about "
                f"{f.values[0]} ({f.sds:.1f} joint standard deviations)"
            )
            shifts = {f.parameter: f.own - f.fitted}
        p = p_value(self.estimates_p_value)
        words = (
            f"{self.flight}, held out: its own estimates are further from those of the fit than "
            f"the errors of both allow (p {p}){most}: the model lacks something, or the flight "
            "differs: mass, rotor speed, battery, or the scale, sign or clock of a column of its "
            "log."
        )
        return Finding(
            "held-out.other-estimates",
            "doubt",
            words,
            self.estimates_p_value,
            f"p value, {LEVEL:g}",
            (self.flight,),
            shifts,
            f"{self.flight} asks for other estimates (p {p})",
        )

    @property
    def _expected(self) -> str:
        return f"95 %: {self.lower95:.3g} to {self.upper95:.3g}"

    @property
    def _size(self) -> str:
        size = f"squared errors are {self.chi_squared:.3g} times what"
        more = self.chi_squared > self.upper95
        if self.responses is not None:
            why = "the model lacks something there" if more else "its noise is taken too large"
            if more and self.estimates_p_value is None:
                # They are not asked for where feedback has its part in the responses.
                why += ", or feedback makes the responses what they are"
            return f"{size} its own noise lets expect ({self._expected}): {why}"
        size = f"{size} the noise of the fitted flights lets expect ({self._expected})"
        # Where they are not asked for, nothing tells these from another machine.
        agree = "" if self.estimates_p_value is None else ", though its own estimates agree"
        what = "more gusts or noise than these, or more" if more else "fewer gusts and less noise"
        rest = " than the model explains" if more else " than these"
        return f"{size}{agree}: it has {what}{rest}"


class HeldOutFrequency(NamedTuple):
    """What the flights held out say in frequency."""

    flights: tuple[HeldOutFlight, ...]
    bands: tuple[HeldOutBand, ...]
    notes: tuple[str, ...]
    """why a flight is not judged"""

    @property
    def findings(self) -> list[Finding]:
        """All that the flights have to say."""
        notes = [note("held-out.not-judged", words) for words in self.notes]
        return [*notes, *(found for f in self.flights for found in f.findings)]
