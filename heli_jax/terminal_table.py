"""Tables and sentences on the terminal: none of their numbers is ever cut off or in two."""

import shutil
import sys
import textwrap
from collections.abc import Sequence
from typing import TextIO

from heli_jax.numbers import terminal_sentence

type _Row = tuple[str, ...]
_BETWEEN = 3
"""columns from one column's end to the next one's beginning"""


def plain_text(text: str) -> str:
    """Words that may hold a name of a log, a file or a configuration, without what a terminal would
    obey: escape sequences, marks that turn the direction of writing, halves of characters."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else " " if c.isspace() else "?" for c in text)


def tell(text: str, file: TextIO | None = None) -> None:
    """Print sentences, on a terminal with new lines between words.

    Args:
        text: what is told; a new line in it stays one.
        file: standard output unless given.
    """
    text = plain_text(terminal_sentence(text))
    stream = sys.stdout if file is None else file
    if stream.isatty():
        width = shutil.get_terminal_size().columns
        text = "\n".join(_folded(line, width) for line in text.split("\n"))
    print(text, file=stream, flush=stream is sys.stderr)


def _folded(line: str, width: int) -> str:
    # A terminal would begin a new line within a number. What is one word, such as a path, it may.
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return textwrap.fill(
        line,
        max(width, 20),
        subsequent_indent=indent,
        replace_whitespace=False,
        break_long_words=False,
        break_on_hyphens=False,
    )


def print_table(head: _Row, rows: list[_Row], *, keys: int = 1) -> None:
    """A table on standard output, its columns as wide as they need.

    What is wider than the terminal is printed as several tables, each with the columns that name
    its rows, or where no further column fits as a list. What is piped on has lines of any length.

    Args:
        head: names of the columns.
        rows: as many cells each.
        keys: columns that name a row together, the first ones.
    """
    head, rows = tuple(map(plain_text, head)), [tuple(map(plain_text, row)) for row in rows]
    # In a pipe nobody knows how wide a line may be, and a program reads it whole.
    most = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    columns = list(zip(head, *rows, strict=True))
    groups = _groups(columns, most, keys)
    if groups is None:
        _print_list(head, rows, keys)
        return
    for group in groups:
        kept_head, *kept_rows = zip(*(columns[i] for i in group), strict=True)
        _print(kept_head, kept_rows)


def _groups(columns: Sequence[_Row], most: int | None, keys: int) -> list[list[int]] | None:
    """Columns by table, the keys in each; None where one does not fit beside them."""
    from rich.cells import cell_len

    widths = [max(map(cell_len, column)) + _BETWEEN for column in columns]
    if most is None or sum(widths) <= most:
        return [list(range(len(columns)))]
    groups: list[list[int]] = []
    room = most - sum(widths[:keys])
    left = 0
    for i, width in enumerate(widths[keys:], keys):
        if width > left:
            groups.append([*range(keys)])
            left = room
        if width > left:
            return None
        groups[-1].append(i)
        left -= width
    return groups or None


def _print_list(head: _Row, rows: Sequence[_Row], keys: int) -> None:
    for row in rows:
        if keys == 1:
            print(f"\n{row[0]}")
        else:
            print()
            for name, cell in zip(head[:keys], row[:keys], strict=True):
                print(f"{name}: {cell}")
        for name, cell in zip(head[keys:], row[keys:], strict=True):
            if cell:
                print(f"  {name}: {cell}" if name else f"  {cell}")
    print()


def _print(head: _Row, rows: Sequence[_Row]) -> None:
    # Imported here, not above: rich takes a tenth of a second, which `heli-jax --help` has not.
    from rich.box import SIMPLE_HEAD
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, name in enumerate(head):
        table.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    widest = sum(max(map(cell_len, column)) for column in zip(head, *rows, strict=True))
    width = widest + _BETWEEN * (len(head) + 1)
    # '[deg]' in a unit or a signal's name is markup to rich and would vanish, ':m:' an emoji.
    console = Console(file=sys.stdout, highlight=False, markup=False, emoji=False, width=width)
    console.print(table)
