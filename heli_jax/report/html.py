"""The report of a fit: one HTML file that holds everything, and its figures as files."""

from collections.abc import Mapping
from pathlib import Path

from heli_jax.report import figures, statements, tables
from heli_jax.report.card import card, summary
from heli_jax.report.charts import Numbers
from heli_jax.report.drawings import (
    GROUPS,
    MOST_FLIGHTS,
    Analysis,
    alt_text,
    caption,
    drawings,
    logged_outputs,
    logged_units,
    worst_output,
)
from heli_jax.report.origin import Origin
from heli_jax.report.page import Picture, filled, picture
from heli_jax.vehicle import Constant
from heli_jax.versions import versions


def write_report(
    directory: Path,
    analysis: Analysis,
    title: str,
    vehicle_constants: Mapping[str, Constant],
    origin: Origin | None = None,
    *,
    png: bool = False,
) -> list[str]:
    """Write report.html and figures/NAME.svg; return the figures' names.

    The page loads nothing from outside itself. Whatever comes from logs and configurations is
    escaped.

    Args:
        directory: where; it exists.
        analysis: the fit and what belongs to it.
        title: of the page.
        vehicle_constants: the vehicle file's, by name.
        origin: command, configuration and files beside the page; nothing of them unless given.
        png: whether to write figures/NAME.png too.

    Raises:
        OSError: the directory cannot be written to.
    """
    folder = directory / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    numbers, shown, logged = Numbers(), list[Picture](), logged_units(analysis)
    # Drawn here, one after the other: of many flights' figures one canvas is in memory at a time.
    for name, draw in drawings(analysis).items():
        units = logged.get(name)
        made = picture(name, draw, numbers, folder=folder, logged=units, png=png)
        if made is not None:
            shown.append(made._replace(alt=alt_text(made, analysis)))
    page = render(analysis, title, vehicle_constants, shown, numbers, origin)
    (directory / "report.html").write_text(page, encoding="utf-8")
    return [made.name for made in shown]


def render(
    analysis: Analysis,
    title: str,
    vehicle_constants: Mapping[str, Constant],
    pictures: list[Picture],
    numbers: Numbers | None = None,
    origin: Origin | None = None,
) -> str:
    """The page as text."""
    fit, problem = analysis.fit, analysis.problem
    numbers, first = numbers or Numbers(), None
    if (worst := worst_output(fit)) is not None:
        chart = figures.overview(*worst, problem.model)
        first = picture("overview", lambda: chart, numbers)
    return filled(
        "report.html.j2",
        title=title,
        fit=fit,
        problem=problem,
        baseline=analysis.baseline,
        more=analysis.supplementary,
        # Once: it takes spectra of every pair of signals.
        card=card(problem, fit),
        summary=summary,
        # The template asks these modules for its words and rows.
        statements=statements,
        tables=tables,
        logged=logged_outputs(analysis),
        constants=tables.constants(problem, vehicle_constants),
        versions=versions(),
        origin=origin,
        unshown=max(0, len(fit.signals) - MOST_FLIGHTS),
        overview=first,
        pictures={
            group: [(p, caption(p)) for p in pictures if p.name.startswith(group)]
            for group in GROUPS
        },
        numbers=numbers.content(),
    )
