"""Output of `heli-jax control`."""

from typing import TYPE_CHECKING

from heli_jax.cli.terminal import print_page_table, print_text

if TYPE_CHECKING:
    from heli_jax.control_workflow import ControlRun


def print_control(run: "ControlRun", *, verbose: bool = False) -> None:
    """Print the share of stable vehicles, margins, the flight, and doubts."""
    from heli_jax.report.control import doubts, flight_table, margins_table, summary, tuning

    print_text(summary(run))
    if words := tuning(run):
        print_text(words)
    print_page_table(margins_table(run))
    if verbose:
        print_page_table(flight_table(run))
    for words in doubts(run):
        print_text(f"! {words}")
    if run.directory is not None:
        print_text(f"gains: {run.directory / 'gains.csv'}")
        print_text(f"report: {run.directory / 'report.html'}")
