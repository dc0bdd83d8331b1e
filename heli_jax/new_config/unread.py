"""What `heli-jax new` says of columns that would be a signal by their names, and cannot be read."""

from collections.abc import Collection, Mapping, Sequence

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.table import shown
from heli_jax.new_config import guess

_MOST = 4
"""columns that are named"""


def unread_notes(
    lacking: Collection[str], called: Mapping[str, Sequence[str]], unread: Mapping[str, str]
) -> list[Finding]:
    """Notes on signals that were not found, where a column that cannot be read is called so.

    Args:
        lacking: signals of the model.
        called: what people call each, words by blanks.
        unread: why, by column.
    """
    columns: dict[str, str] = {}
    for signal in lacking:
        for name in guess.by_name(called[signal], list(unread))[:1]:
            columns.setdefault(name, signal)
    return [
        note(LEFT_OUT, f"{signal} may be the column {shown(name)}, which {unread[name]}", name)
        for name, signal in list(columns.items())[:_MOST]
    ]
