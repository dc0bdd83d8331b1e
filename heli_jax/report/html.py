"""The report of a fit: one HTML file that holds everything, and its figures as files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from heli_jax.identification.result import Fit
from heli_jax.report import card, statements, tables
from heli_jax.report.captions import GROUPS, alt_text, caption
from heli_jax.report.drawings import MOST_FLIGHTS, Analysis, drawings, logged_outputs, logged_units
from heli_jax.report.embedded import Numbers
from heli_jax.report.origin import Origin
from heli_jax.report.page import filled
from heli_jax.report.pictures import Kind, Picture, picture
from heli_jax.vehicle import Constant
from heli_jax.versions import versions

_LIVE = ("response", "bode", "match", "held", "rls")
"""figures that the page draws itself, to be zoomed: those over time and over frequency"""


def _kind(name: str) -> Kind:
    if name.startswith(_LIVE):
        return "live"
    return "panels" if name.startswith("residual") else "image"


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
    numbers, shown, logged = Numbers(), [], logged_units(analysis)
    # Drawn here, one after the other: of many flights' figures one canvas is in memory at a time.
    for name, draw in drawings(analysis).items():
        made = picture(
            name,
            draw,
            numbers,
            folder=folder,
            logged=logged.get(name),
            kind=_kind(name),
            png=png,
        )
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
    """The page as text.

    Args:
        analysis: the fit and what belongs to it.
        title: of the page.
        vehicle_constants: the vehicle file's, by name.
        pictures: the figures that were drawn.
        numbers: those that the page draws itself.
        origin: as of `write_report`.
    """
    return filled(
        "report.html.j2",
        title=title,
        **_results(analysis),
        **_more_results(analysis),
        **_provenance(analysis, vehicle_constants),
        origin=origin,
        unshown=max(0, len(analysis.fit.signals) - MOST_FLIGHTS),
        pictures={
            group: [
                (p, caption(p, rls=analysis.baseline is not None))
                for p in pictures
                if p.name.startswith(group)
            ]
            for group in GROUPS
        },
        numbers=(numbers or Numbers()).content(),
    )


def _results(analysis: Analysis) -> dict[str, Any]:
    """What every fit has."""
    fit, problem, baseline, _ = analysis
    # Once: it takes spectra of every pair of signals.
    lines = card.card(problem, fit)
    return {
        "fit": fit,
        "problem": problem,
        "baseline": baseline,
        "headline": statements.headline(fit),
        "sentences": statements.further_sentences(fit),
        "meanings": statements.meanings(fit),
        "warnings": statements.warnings(fit),
        "remark": statements.model_remark(problem),
        "parameters": tables.parameters(fit),
        "prior_note": tables.prior_note(problem, fit),
        "nuisances": tables.nuisances(fit),
        "combinations": tables.combinations(fit),
        "agreement": tables.agreement(fit, baseline, logged_outputs(analysis)),
        "fitted_to": tables.responses(fit.responses),
        **_held_out(fit),
        "acceptance": tables.acceptance(lines),
        "summary": card.summary(lines),
        "residuals": tables.residuals(fit, problem),
        "verdict": tables.verdict(fit),
        "starts": tables.starts(fit),
    }


def _held_out(fit: Fit) -> dict[str, Any]:
    """Tables of the flights held out, in frequency; None where nothing was asked."""
    held = fit.held_out_frequency
    return {
        "held_out_flights": tables.held_out_flights(held),
        "held_out_bands": tables.held_out_bands(held),
        "held_out_responses": [
            (flight.flight, tables.responses(flight.responses))
            for flight in (held.flights if held else ())
            if flight.responses is not None
        ],
    }


def _more_results(analysis: Analysis) -> dict[str, Any]:
    """What was asked for beside the fit; None, or a table without rows, where it was not."""
    fit, problem, baseline, more = analysis
    guess = problem.first_guess
    handling = more.responses.handling if more.responses else ()
    return {
        "supplementary": more,
        "sensors": more.sensors,
        "sensor_errors": tables.Table(more.sensors.head, list(more.sensors.errors))
        if more.sensors
        else None,
        "choice": tables.choice(more.choice) if more.choice else None,
        "intervals": tables.intervals(more.intervals, fit) if more.intervals else None,
        "sampling": _sampling(analysis),
        "methods": tables.methods(more.methods) if more.methods else None,
        "guess": guess,
        "guess_method": tables.start_method(guess) if guess else "",
        "first_guess": tables.first_guess(guess) if guess else None,
        "selection": tables.selection_steps(guess) if guess else None,
        "ratios": tables.baseline_ratios(fit, baseline) if baseline else None,
        "facts": tables.baseline_facts(baseline) if baseline else None,
        "responses": more.responses,
        "handling": tables.handling(handling),
        "handling_sentences": tables.handling_sentences(handling),
    }


def _sampling(analysis: Analysis) -> tables.Table | None:
    """Whether the chains agree; None where there are none."""
    comparison = analysis.supplementary.intervals
    if comparison is None or comparison.posterior is None:
        return None
    return tables.sampling(comparison.posterior)


def _provenance(analysis: Analysis, vehicle_constants: Mapping[str, Constant]) -> dict[str, Any]:
    """Where data and numbers came from."""
    fit, problem, _, _ = analysis
    return {
        "origins": tables.origins(fit, problem),
        "constants": tables.constants(problem, vehicle_constants),
        "versions": tables.pairs(versions()),
        "timing": tables.pairs(fit.timing, " s"),
    }
