"""Findings about a record, a model or a fit, and the rule that derives a result from them.

A finding is data: a stable code, a severity, a value with its limit, and its effect on the
estimates. `messages.yaml` has the text for each code; no code depends on that text.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from heli_jax.messages import messages, sentence, written

Severity = Literal["ok", "note", "doubt", "refuse"]
"""Severity of a finding.

ok: tested, nothing found; note: for information; doubt: a possible fault; refuse: a fit of this
record cannot give the requested estimates.
"""

LEFT_OUT = "channels.left-out"
"""Code of the finding on parts of a log that are not read."""
_IN_FULL = 3
"""Findings that the terminal and a page's first screen show in full."""
HALF_INTERVAL = 1.96
"""Half-width of a 95 % interval [standard deviations]. A misfit that shifts the estimate further
leaves the true value outside the interval.
"""


class Finding(NamedTuple):
    """A finding; its field names are keys of fit.json."""

    code: str
    """Stable code, such as `timing.input-late`: the topic, then the finding."""
    severity: Severity
    sentence: str
    value: float | None = None
    criterion: str = ""
    """Meaning of `value`, and its limit."""
    subjects: tuple[str, ...] = ()
    """Signals, parameters or flights that it concerns."""
    shifts: Mapping[str, float] = MappingProxyType({})
    """Shift of each estimate by this misfit [SI], from one step of the score test."""
    brief: str = ""
    """Short form for the statements of a report."""
    denies: bool = False
    """True if the finding shows that the model does not explain the record."""
    distrusts: tuple[str, ...] = ()
    """Parameters whose intervals become unusable by an unknown amount."""

    def of(self, whose: str) -> "Finding":
        """Return the finding with its log, flight or signal at the start of the sentence."""
        return self._replace(sentence=f"{whose}: {self.sentence}")

    @property
    def topic(self) -> str:
        """Heading of the finding."""
        known = messages().get(self.code)
        return known.title if known else self.code.partition(".")[2].replace("-", " ")

    @property
    def bad(self) -> bool:
        """True for a doubt or a refusal."""
        return self.severity in ("doubt", "refuse")


class Distrust(NamedTuple):
    """Reason why the interval of an estimate is unusable; its field names are keys of fit.json."""

    code: str
    """Code of the finding."""
    brief: str


# Any: numbers, names and lists of these, for the sentence.
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
    """Return a finding with the text of `messages.yaml` for its code.

    Args:
        subjects: signals, parameters or flights that it concerns.
        shifts: shift of each estimate by the misfit [SI].
        denies: True if it shows that the model does not explain the record.
        numbers: values for the fields of the sentence; `flight` comes before the sentence.
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
    """Return a finding that is for information only."""
    return Finding(code, "note", sentence, value, subjects=subjects)


def as_data(finding: Finding) -> dict[str, Any]:
    """Return a finding as plain data."""
    return {**finding._asdict(), "shifts": dict(finding.shifts)}


def without_repeats(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings without repeated sentences."""
    by_sentence: dict[str, Finding] = {}
    for finding in findings:
        by_sentence.setdefault(finding.sentence, finding)
    return list(by_sentence.values())


def most_severe(findings: Sequence[Finding]) -> list[Finding]:
    """Return the most severe findings, one of each topic; `findings` begin with the most severe."""
    # The first finding represents all flights or signals with the same one.
    by_topic = {f.topic: f for f in reversed(findings) if f.severity != "ok"}
    return [f for f in findings if f is by_topic.get(f.topic)][:_IN_FULL]


def sentences(findings: Iterable[Finding]) -> list[str]:
    """Return the sentences of findings without repetition."""
    return [f.sentence for f in without_repeats(findings)]


def distrusted(findings: Sequence[Finding], estimates: Mapping[str, Any]) -> dict[str, Distrust]:
    """Return the finding that makes each parameter's interval unusable, the largest shift first.

    Args:
        estimates: estimates by parameter, with `sd` [SI], None if not identifiable.
    """
    known = {name: e for name, e in estimates.items() if e.sd is not None}

    def parts(f: Finding) -> dict[str, float]:
        """Return the shifts over half an interval."""
        return {
            n: abs(f.shifts.get(n, 0.0)) / max(HALF_INTERVAL * e.sd, 1e-300)
            for n, e in known.items()
        }

    # One step gives the size to first order only, which may be wrong by a factor of ten. If a
    # misfit invalidates one interval, it also invalidates those that it shifts half as far.
    takes = [
        (f, by, 0.5 if max(by.values(), default=0.0) > 1.0 else 1.0)
        for f, by in ((f, parts(f)) for f in findings)
    ]
    out: dict[str, Distrust] = {}
    for name in known:
        moved = [(by[name], f) for f, by, most in takes if by[name] > most]
        unsized = [f for f in findings if name in f.distrusts]
        if moved:
            _, first = max(moved, key=lambda one: one[0])
            out[name] = Distrust(first.code, first.brief)
        elif unsized:
            out[name] = Distrust(unsized[0].code, unsized[0].brief)
    return out


def rated(findings: Iterable[Finding], estimates: Mapping[str, Any]) -> list[Finding]:
    """Return the findings, with severity doubt if a misfit makes an interval unusable, else note.

    Args:
        estimates: estimates by parameter, with `sd` [SI].
    """
    out = []
    for f in findings:
        if f.shifts and not f.denies and f.severity != "refuse":
            moved = bool(distrusted([f], estimates))
            f = f._replace(severity="doubt" if moved else "note")
        out.append(f)
    return out


def exit_code(status: str, adequate: bool, distrusts: Mapping[str, Distrust]) -> int:
    """Return the exit code of a fit, which also sets the statements and the light of the page.

    0: the intervals are usable. 3: the record contradicts the numbers (not identifiable, or not
    trusted). 4: not converged, or the model does not explain the record.

    Args:
        distrusts: result of `distrusted`.
    """
    if status == "not-converged" or not adequate:
        return 4
    return 3 if status == "not-identifiable" or distrusts else 0
