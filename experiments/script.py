"""Command line shared by the studies: --help, --quick, --out, and the expected time."""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple


class Size(NamedTuple):
    """A positional number or word of a study, with its value for a quick run."""

    name: str
    default: int | float | str
    quick: int | float | str
    help: str


def asked(doc: str | None, takes: str, *sizes: Size, out: str | None = None) -> argparse.Namespace:
    """Return the options of a study; print the expected time on standard error.

    Args:
        doc: the study's docstring, for --help.
        takes: time at full size on two cores, in words.
        sizes: positional arguments, in order.
        out: output folder of the study; None if it only prints.
    """
    parser = argparse.ArgumentParser(
        description=doc,
        epilog=f"At full size: {takes} on two cores.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for size in sizes:
        parser.add_argument(
            size.name, nargs="?", type=type(size.default), help=f"{size.help} ({size.default})"
        )
    # Without sizes there is no quick run.
    if sizes:
        parser.add_argument("--quick", action="store_true", help="small, to see that it runs")
    if out is not None:
        parser.add_argument(
            "--out", type=Path, default=Path(out), metavar="FOLDER", help=f"({out})"
        )
    options = parser.parse_args()
    for size in sizes:
        if getattr(options, size.name) is None:
            setattr(options, size.name, size.quick if options.quick else size.default)
    asked_for = ", ".join(f"{s.name} {getattr(options, s.name)}" for s in sizes)
    where = f"; writes to {options.out}" if out is not None else ""
    print(f"{asked_for or 'one study'}; at full size {takes} on two cores{where}", file=sys.stderr)
    return options


if __name__ == "__main__":
    print(__doc__, "\nA part of the scripts beside it: by itself it does nothing.")
