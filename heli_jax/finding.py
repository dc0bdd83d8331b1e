"""Findings about a record, a model or a fit, and the one rule that concludes from them.

A finding is data: a stable code, a severity, its number and limit, and what it does to the
estimates. `messages.yaml` has the words for each code; no code reads them.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from heli_jax.messages import messages, sentence, written

Severity = Literal["ok", "note", "doubt", "refuse"]
"""ok: tested, nothing found; note: for information; doubt: something may be wrong; refuse: a fit of
this record says nothing of what is asked"""

LEFT_OUT = "channels.left-out"
"""code of what of a log is not read"""
_FARTHEST = 10.0
"""times an estimate that one step of a test moves it; farther it tells no size"""
HALF_INTERVAL = 1.96
"""standard deviations from an estimate to the end of its 95 % interval; a misfit that moves it
further leaves an interval without the truth in it"""


class Finding(NamedTuple):
    """One finding. The names of the fields are keys of fit.json."""

    code: str
    """stable, as `timing.input-late`: the topic, then what was found"""
    severity: Severity
    sentence: str
    value: float | None = None
    criterion: str = ""
    """what `value` is, and the limit that it is held against"""
    subjects: tuple[str, ...] = ()
    """signals, parameters or flights that it is about"""
    shifts: Mapping[str, float] = MappingProxyType({})
    """by parameter: how far this misfit moves its estimate [SI], by one step of the score test"""
    brief: str = ""
    """the finding in a few words, for the statements of a report"""
    denies: bool = False
    """whether it shows that the model does not explain the record"""
    distrusts: tuple[str, ...] = ()
    """parameters whose intervals it makes unusable by an amount that is not known"""

    def of(self, whose: str) -> "Finding":
        """The same, whose sentence says first of which log, flight or signal it is."""
        return self._replace(sentence=f"{whose}: {self.sentence}")

    @property
    def topic(self) -> str:
        """Heading of the finding."""
        known = messages().get(self.code)
        return known.title if known else self.code.partition(".")[2].replace("-", " ")

    @property
    def bad(self) -> bool:
        """True for a doubt, or worse."""
        return self.severity in ("doubt", "refuse")


class Distrust(NamedTuple):
    """Reason why the interval of one estimate may not be used. The names of the fields are keys
    of fit.json."""

    code: str
    """of the finding"""
    shift: float | None
    """how far the misfit moves the estimate [SI]; None where that is not known"""
    brief: str


# Any: numbers, names and lists of these, which the sentence shows.
def found(
    code: str,
    severity: Severity = "doubt",
    *subjects: str,
    value: float | None = None,
    shifts: Mapping[str, float] = MappingProxyType({}),
    denies: bool = False,
    distrusts: Iterable[str] = (),
    **numbers: Any,
) -> Finding:
    """A finding with the words that `messages.yaml` has for its code.

    Args:
        subjects: signals, parameters or flights that it is about.
        shifts: by parameter how far the misfit moves its estimate [SI].
        denies: whether it shows that the model does not explain the record.
        numbers: what the sentence shows, by the names of its fields; `flight` stands before it.
    """
    message = messages()[code]
    shown = {"value": value, "subjects": subjects, **numbers}
    whose = f"{numbers['flight']}: " if "flight" in numbers else ""
    return Finding(
        code,
        severity,
        whose + sentence(code, **shown),
        value,
        written(message.measure, shown),
        subjects,
        shifts,
        written(message.brief, shown),
        denies,
        tuple(distrusts),
    )


def note(code: str, sentence: str, *subjects: str, value: float | None = None) -> Finding:
    """A finding for information alone."""
    return Finding(code, "note", sentence, value, subjects=subjects)


def as_data(finding: Finding) -> dict[str, Any]:
    """A finding as plain data."""
    return {**finding._asdict(), "shifts": dict(finding.shifts)}


def once(findings: Iterable[Finding]) -> list[Finding]:
    """The findings, each sentence once."""
    by_sentence: dict[str, Finding] = {}
    for finding in findings:
        by_sentence.setdefault(finding.sentence, finding)
    return list(by_sentence.values())


def sentences(findings: Iterable[Finding]) -> list[str]:
    """The sentences of findings, each once."""
    return [f.sentence for f in once(findings)]


def distrusted(findings: Sequence[Finding], estimates: Mapping[str, Any]) -> dict[str, Distrust]:
    """By parameter the finding that takes its interval away, the largest shift first.

    Args:
        estimates: by parameter, with `value` and `sd` [SI]; None where it is not identifiable.
    """
    known = {name: e for name, e in estimates.items() if e.sd is not None}

    def parts(f: Finding) -> dict[str, float]:
        """Shifts over half an interval."""
        return {
            n: abs(f.shifts.get(n, 0.0)) / max(HALF_INTERVAL * e.sd, 1e-300)
            for n, e in known.items()
        }

    # One step is a size to first order: a misfit that takes one interval away takes those that it
    # may move as far, by an amount that is not known.
    takes = [
        (f, by, 0.5 if max(by.values(), default=0.0) > 1.0 else 1.0)
        for f, by in ((f, parts(f)) for f in findings)
    ]
    out: dict[str, Distrust] = {}
    for name, estimate in known.items():
        moved = [(by[name], f) for f, by, most in takes if by[name] > most]
        unsized = [f for f in findings if name in f.distrusts]
        if moved:
            part, first = max(moved, key=lambda one: one[0])
            shift = float(first.shifts[name])
            sized = part > 1.0 and abs(shift) <= _FARTHEST * max(abs(estimate.value), estimate.sd)
            out[name] = Distrust(first.code, shift if sized else None, first.brief)
        elif unsized:
            out[name] = Distrust(unsized[0].code, None, unsized[0].brief)
    return out


def weighed(findings: Iterable[Finding], estimates: Mapping[str, Any]) -> list[Finding]:
    """The findings, a doubt of those that take an interval away and a note of misfits that do not.

    Args:
        estimates: by parameter, with `sd` [SI].
    """
    out = []
    for f in findings:
        if f.shifts and not f.denies and f.severity != "refuse":
            moved = bool(distrusted([f], estimates))
            f = f._replace(severity="doubt" if moved else "note")
        out.append(f)
    return out


def exit_code(status: str, adequate: bool, distrusts: Mapping[str, Distrust]) -> int:
    """The exit code of a fit, which the statements and the page's light follow.

    0: the intervals may be used as they stand. 3: something in the record contradicts the numbers
    (not identifiable, or not trusted). 4: not converged, or the model does not explain the record.

    Args:
        distrusts: of `distrusted`.
    """
    if status == "not-converged" or not adequate:
        return 4
    return 3 if status == "not-identifiable" or distrusts else 0
