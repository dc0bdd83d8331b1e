"""Output of `heli-jax design`."""

from typing import TYPE_CHECKING

from heli_jax.cli.terminal import print_page_table, print_text
from heli_jax.errors import InputError

if TYPE_CHECKING:
    from heli_jax.design_workflow import DesignRun

_ROWS = 5
"""Manoeuvres of the library in the table."""


def wanted_sds(texts: list[str]) -> dict[str, float]:
    """Return relative sds by parameter from texts such as `a=2%`.

    Raises:
        InputError: a text is no such.
    """
    wanted = {}
    for text in texts:
        name, equals, value = text.partition("=")
        number = value.strip().removesuffix("%")
        try:
            share = float(number) * (0.01 if value.strip().endswith("%") else 1.0)
        except ValueError:
            share = 0.0
        if not (equals and name.strip() and 0.0 < share < 10.0):
            raise InputError(f"--for {text!r:.80}: expected NAME=PERCENT, such as a=2%")
        wanted[name.strip()] = share
    return wanted


def print_design(run: "DesignRun", *, verbose: bool = False) -> None:
    """Print the design: what it gains, the inputs compared, and doubts."""
    from heli_jax.report.design import doubts, manoeuvres_table, summary

    print_text(summary(run))
    print_page_table(manoeuvres_table(run, len(run.design.library) if verbose else _ROWS))
    for i, known in enumerate(run.design.optimum.known):
        if known:
            words = ", ".join(f"{n} = {v:.4g}" for n, v in known.items())
            print_text(f"run {i + 1}: {words}")
    for words in doubts(run):
        print_text(f"! {words}")
    if run.directory is not None:
        print_text(f"input: {run.directory / 'input.csv'}")
        print_text(f"report: {run.directory / 'report.html'}")
