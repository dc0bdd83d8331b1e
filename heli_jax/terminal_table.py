"""Tables on the terminal."""

import sys


def print_table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """A table on standard output, its columns as wide as they need."""
    # Imported here, not above: rich takes a tenth of a second, which `heli-jax --help` has not.
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, name in enumerate(head):
        table.add_column(_escaped(name), justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(_escaped(cell) for cell in row))
    # In a pipe rich assumes 80 columns and cuts off what is wider.
    width = None if sys.stdout.isatty() else 120
    Console(file=sys.stdout, highlight=False, width=width).print(table)


def _escaped(text: str) -> str:
    from rich.markup import escape

    # '[deg]' in a unit or a signal's name is markup to rich, and would vanish.
    return escape(text)
