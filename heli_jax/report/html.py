"""The report of a fit: one HTML file that holds everything, and its figures as files."""

import base64
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
from matplotlib.figure import Figure

from heli_jax import naming
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.fit import Fit
from heli_jax.identification.problem import Problem
from heli_jax.report import card, figures, style, tables
from heli_jax.report.files import SupplementaryAnalyses
from heli_jax.report.fitted_responses import FittedPair
from heli_jax.report.frequency import FittedFlight
from heli_jax.report.page import filled
from heli_jax.vehicle import Constant
from heli_jax.versions import versions

MOST_FLIGHTS = 6
"""flights that get figures of their own; signals.csv has them all"""


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


class Analysis(NamedTuple):
    """A fit, and all that its report is made of."""

    fit: Fit
    problem: Problem
    baseline: Baseline | None = None
    supplementary: SupplementaryAnalyses = SupplementaryAnalyses()


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


type Draw = Callable[[], Figure | None]


def drawings(analysis: Analysis) -> dict[str, Draw]:
    """Every figure of the report by its file name, not yet drawn."""
    fit, problem, baseline, supplementary = analysis
    model, drawings = problem.model, {}
    if supplementary.intervals is not None:
        drawings["intervals"] = _drawing(figures.intervals, supplementary.intervals, fit)
    parts = _parts([s.flight for s in fit.signals])
    for i in _drawn([s.hold_out for s in fit.signals]):
        s, part = fit.signals[i], parts[i]
        for output in s.measured:
            drawings[f"response{part}_{output}"] = _drawing(figures.response, s, output, model)
            # The fit did nothing to make the residuals of a flight held out white.
            if not s.hold_out:
                drawings[f"residual{part}_{output}"] = _drawing(
                    figures.residual_correlation, s, output, together=len(fit.whiteness)
                )
    if fit.signals[0].inputs:
        drawings["bode"] = _bode(fit, problem, baseline)
    for pair in supplementary.responses.pairs if supplementary.responses else ():
        drawings[f"match_{pair.output}-{pair.input}"] = _match(pair, analysis)
    if len(fit.verdict.names) > 1:
        drawings["correlation"] = _drawing(figures.correlation_matrix, fit.verdict)
    drawings["starts"] = _drawing(figures.waterfall, fit.starts)
    if baseline is not None:
        drawings["rls"] = _drawing(figures.rls_history, baseline)
    return drawings


def _drawn(hold_out: list[bool]) -> list[int]:
    """Which flights get figures: where there are too many, not only the fitted ones, which come
    first, but half of them held out."""
    held = [i for i, out in enumerate(hold_out) if out][: MOST_FLIGHTS // 2]
    fitted = [i for i, out in enumerate(hold_out) if not out][: MOST_FLIGHTS - len(held)]
    rest = [i for i in range(len(hold_out)) if i not in {*held, *fitted}]
    return sorted([*fitted, *held, *rest[: MOST_FLIGHTS - len(held) - len(fitted)]])


def _parts(flights: list[str]) -> list[str]:
    """What tells the flights' file names apart; nothing where there is one flight."""
    if len(flights) == 1:
        return [""]
    # Names come from logs and may hold slashes, and two may be equal but for what is left out: the
    # number keeps their files apart.
    return [
        f"_{i + 1}_{re.sub('[^A-Za-z0-9]+', '-', f).strip('-')[:40]}".rstrip("_")
        for i, f in enumerate(flights)
    ]


def _drawing(function: Callable[..., figures.Panels], *args: Any, **options: Any) -> Draw:
    # Drawn when it is asked for: `FitRun.figure` wants one of them and draws no other.
    def draw() -> Figure | None:
        axes = function(*args, **options)
        return axes[0].figure if axes else None  # type: ignore[return-value]

    return draw


def _bode(fit: Fit, problem: Problem, baseline: Baseline | None) -> Draw:
    """The frequency response of the flight that the baseline saw, with what is known of it."""
    # The first flight where there is no baseline.
    i = next((i for i, s in enumerate(fit.signals) if baseline and s.flight == baseline.flight), 0)
    # What the flight states of the vehicle goes before the estimates, as in the fit.
    # Signals hold the fitted flights first, in the order of `training`; those held out follow.
    known = problem.training[i].known if i < len(problem.training) else {}
    params = naming.replace(fit.params, **{n: jnp.asarray(v) for n, v in known.items()})
    flight = FittedFlight(problem.model, params, fit, fit.signals[i])
    return _drawing(figures.bode, flight, baseline)


def _match(pair: FittedPair, analysis: Analysis) -> Draw:
    responses = analysis.supplementary.responses
    assert responses is not None
    about = f"model linearised about {responses.about}" if responses.about else "continuous model"
    note = f"{about}; data without the hold of the input, flights together"
    unit = figures.bode_unit(analysis.problem.model, pair.output, pair.input)
    return _drawing(figures.match, pair, unit, note)


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
    fit, problem, baseline, supplementary = analysis
    # Once: it takes spectra of every pair of signals.
    lines = card.card(problem, fit)
    return filled(
        "report.html.j2",
        title=title,
        fit=fit,
        problem=problem,
        baseline=baseline,
        headline=tables.headline(fit),
        sentences=tables.further_sentences(fit),
        meanings=tables.meanings(fit),
        warnings=tables.warnings(fit),
        remark=tables.model_remark(problem),
        parameters=tables.parameters(fit),
        prior_note=tables.prior_note(problem, fit),
        nuisances=tables.nuisances(fit),
        combinations=tables.combinations(fit),
        agreement=tables.agreement(fit, baseline),
        fitted_to=tables.responses(fit),
        supplementary=supplementary,
        choice=tables.choice(supplementary.choice) if supplementary.choice else None,
        intervals=tables.intervals(supplementary.intervals, fit)
        if supplementary.intervals
        else None,
        methods=tables.methods(supplementary.methods) if supplementary.methods else None,
        acceptance=tables.acceptance(lines),
        summary=card.summary(lines),
        residuals=tables.residuals(fit, problem),
        verdict=tables.verdict(fit),
        starts=tables.starts(fit),
        guess=problem.first_guess,
        guess_method=tables.start_method(problem.first_guess) if problem.first_guess else "",
        first_guess=tables.first_guess(problem.first_guess) if problem.first_guess else None,
        selection=tables.selection_steps(problem.first_guess) if problem.first_guess else None,
        ratios=tables.baseline_ratios(fit, baseline) if baseline else None,
        facts=tables.baseline_facts(baseline) if baseline else None,
        origins=tables.origins(fit, problem),
        constants=tables.constants(problem, vehicle_constants),
        versions=tables.pairs(versions()),
        timing=tables.pairs(fit.timing, " s"),
        responses=supplementary.responses,
        handling=tables.handling(
            supplementary.responses.handling if supplementary.responses else ()
        ),
        handling_sentences=tables.handling_sentences(
            supplementary.responses.handling if supplementary.responses else ()
        ),
        unshown=max(0, len(fit.signals) - MOST_FLIGHTS),
        pictures={group: [p for p in pictures if p.name.startswith(group)] for group in _GROUPS},
        NOT_DETERMINED=tables.NOT_DETERMINED,
    )
