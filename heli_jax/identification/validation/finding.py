"""What is found out about a record before any fit: one sentence with its number and criterion."""

from typing import Literal, NamedTuple

Severity = Literal["ok", "note", "doubt", "refuse"]
"""note: what was not tested, or is advice and no test; refuse: a fit of this record says nothing of
what is asked"""


class Finding(NamedTuple):
    """One answer to "Is this log enough?". The names of the fields are keys of fit.json."""

    topic: str
    severity: Severity
    sentence: str
    value: float | None = None
    criterion: str = ""
    """what `value` is, and the limit that it is held against"""

    @property
    def bad(self) -> bool:
        """Whether it is a doubt, or worse."""
        return self.severity in ("doubt", "refuse")
