"""The command line that the studies share: --help, --quick, --out, and what they will take."""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple


class Size(NamedTuple):
    """A number or a word that a study takes by its place, with the one of a quick look."""

    name: str
    default: int | float | str
    quick: int | float | str
    help: str


def asked(doc: str | None, takes: str, *sizes: Size, out: str | None = None) -> argparse.Namespace:
    """What was asked of a study; it says on standard error what that will take.

    Args:
        doc: the study's docstring, for --help.
        takes: at full size, on two cores, in words.
        sizes: by their place on the command line.
        out: the folder that the study writes to; None where it only prints.
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
    # What has no size has no small one either.
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
