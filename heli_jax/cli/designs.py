"""Output of `heli-jax design`."""

from typing import TYPE_CHECKING

from heli_jax.cli.terminal import print_page_table, print_text
from heli_jax.cli.wanted import wanted_of
from heli_jax.errors import InputError

if TYPE_CHECKING:
    from heli_jax.design_workflow import DesignRun

_ROWS = 5
"""Manoeuvres of the library in the table."""


def wanted_sds(texts: list[str]) -> dict[str, float]:
    """Return relative sds by parameter from texts such as `a=2%`.

    Raises:
        InputError: a text of another form, or an sd that is not relative.
    """
    wanted = wanted_of(texts)
    for name, one in wanted.items():
        if not one.relative:
            raise InputError(f"--for {name!r:.60}: expected NAME=PERCENT, such as a=2%")
    return {name: one.sd for name, one in wanted.items()}


def print_design(run: "DesignRun", *, verbose: bool = False) -> None:
    """Print the design: what it gains, the inputs compared, and doubts."""
    from heli_jax.report.design import (
        doubts,
        known_differences,
        manoeuvres_table,
        signals_played,
        summary,
    )

    print_text(summary(run))
    print_page_table(manoeuvres_table(run, len(run.design.library) if verbose else _ROWS))
    for words in known_differences(run):
        print_text(words)
    for words in doubts(run):
        print_text(f"! {words}")
    if run.directory is not None:
        for words in signals_played(run):
            print_text(words)
        print_text(f"input: {run.directory / 'input.csv'}")
        print_text(f"report: {run.directory / 'report.html'}")
