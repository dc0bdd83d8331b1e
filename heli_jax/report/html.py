"""The report of a fit: one HTML file that holds everything, and its figures as files."""

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from heli_jax.report import card, style, tables
from heli_jax.report.drawings import MOST_FLIGHTS, Analysis, drawings
from heli_jax.report.page import filled
from heli_jax.vehicle import Constant
from heli_jax.versions import versions

_CAPTIONS = {
    "response": "From above, over time: measured and simulated, what is left between them, inputs.",
    "residual": "From above, by lag: its correlation with itself, then with each input; of white "
    "noise 99 % of the lags lie within the band.",
    "bode": "Magnitude and phase of the fitted model, of the recursive least squares where there "
    "are some, and of the record where its coherence allows.",
    "match": "From above: gain and phase of model and data with 95 % intervals, partial coherence "
    "of the data, and data over model. Grey: envelopes of what pilots of full-size aeroplanes "
    "did not notice (Wood and Hodgkinson, 1980).",
    "correlation": "Near +1 or -1 the data hardly tell two parameters apart.",
    "starts": "The misfit that each start of the optimiser reached, best first.",
    "rls": "Each coefficient while the record goes by: one to be trusted settles.",
    "intervals": "Of each parameter, by every method; the dotted line is the estimate.",
}
"""by group, what a figure shows, after its title"""
_GROUPS = tuple(_CAPTIONS)
# The template asks for figures by what their names begin with: no group may begin another's name.


class Picture(NamedTuple):
    """A figure as the page holds it."""

    name: str
    title: str
    data: str
    """SVG in base64"""

    @property
    def alt(self) -> str:
        """What a reader who does not see the figure is told."""
        if self.name.startswith("match"):
            return (
                f"{self.title}: Bode plot of both with intervals, coherence, and the error between "
                "them within the envelopes of mismatch"
            )
        return self.title

    @property
    def caption(self) -> str:
        """What the figure shows, and the name of its files."""
        [words] = [w for group, w in _CAPTIONS.items() if self.name.startswith(group)]
        return f"{self.title}. {words} (figures/{self.name}.svg, .png)"


def write_report(
    directory: Path, analysis: Analysis, title: str, vehicle_constants: Mapping[str, Constant]
) -> list[str]:
    """Write report.html, figures/NAME.svg and figures/NAME.png; return the figures' names.

    The page refers to nothing outside itself. Whatever comes from logs and configurations is
    escaped.

    Args:
        directory: where; it exists.
        analysis: the fit and what belongs to it.
        title: of the page.
        vehicle_constants: the vehicle file's, by name.

    Raises:
        OSError: the directory cannot be written to.
    """
    folder = directory / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    # Drawn here, one after the other: of many flights' figures one canvas is in memory at a time.
    for name, draw in drawings(analysis).items():
        saved = style.save(draw, folder / name)
        if saved is not None:
            # In the page itself, as base64: a report is one file, to be mailed or archived, and a
            # browser opens it from anywhere.
            picture_title, svg = saved
            pictures.append(Picture(name, picture_title, base64.b64encode(svg).decode("ascii")))
    page = render(analysis, title, vehicle_constants, pictures)
    (directory / "report.html").write_text(page, encoding="utf-8")
    return [picture.name for picture in pictures]


def render(
    analysis: Analysis,
    title: str,
    vehicle_constants: Mapping[str, Constant],
    pictures: list[Picture],
) -> str:
    """The page as text.

    Args:
        analysis: the fit and what belongs to it.
        title: of the page.
        vehicle_constants: the vehicle file's, by name.
        pictures: the figures that were drawn.
    """
    return filled(
        "report.html.j2",
        title=title,
        **_results(analysis),
        **_more_results(analysis),
        **_provenance(analysis, vehicle_constants),
        unshown=max(0, len(analysis.fit.signals) - MOST_FLIGHTS),
        pictures={group: [p for p in pictures if p.name.startswith(group)] for group in _GROUPS},
        NOT_DETERMINED=tables.NOT_DETERMINED,
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
        "headline": tables.headline(fit),
        "sentences": tables.further_sentences(fit),
        "meanings": tables.meanings(fit),
        "warnings": tables.warnings(fit),
        "remark": tables.model_remark(problem),
        "parameters": tables.parameters(fit),
        "prior_note": tables.prior_note(problem, fit),
        "nuisances": tables.nuisances(fit),
        "combinations": tables.combinations(fit),
        "agreement": tables.agreement(fit, baseline),
        "fitted_to": tables.responses(fit),
        "acceptance": tables.acceptance(lines),
        "summary": card.summary(lines),
        "residuals": tables.residuals(fit, problem),
        "verdict": tables.verdict(fit),
        "starts": tables.starts(fit),
    }


def _more_results(analysis: Analysis) -> dict[str, Any]:
    """What was asked for beside the fit; None, or a table without rows, where it was not."""
    fit, problem, baseline, more = analysis
    guess = problem.first_guess
    handling = more.responses.handling if more.responses else ()
    return {
        "supplementary": more,
        "choice": tables.choice(more.choice) if more.choice else None,
        "intervals": tables.intervals(more.intervals, fit) if more.intervals else None,
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


def _provenance(analysis: Analysis, vehicle_constants: Mapping[str, Constant]) -> dict[str, Any]:
    """Where data and numbers came from."""
    fit, problem, _, _ = analysis
    return {
        "origins": tables.origins(fit, problem),
        "constants": tables.constants(problem, vehicle_constants),
        "versions": tables.pairs(versions()),
        "timing": tables.pairs(fit.timing, " s"),
    }
