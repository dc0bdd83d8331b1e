"""Report of a fit: one HTML file with figures, captions and the three statements."""

import functools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.finding import most_severe
from heli_jax.identification.identifiability.verdict import FACTOR
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Fit, Signals
from heli_jax.identification.validation.adequacy import (
    EXPECTED,
    EXPLAINED,
    NEARLY_WHITE,
)
from heli_jax.identification.validation.metrics import metrics
from heli_jax.numbers import percent, vaf_percent
from heli_jax.report import figures, tables
from heli_jax.report.card import card, summary
from heli_jax.report.charts import Numbers
from heli_jax.report.files import Analysis as Analysis
from heli_jax.report.origin import Origin, origin
from heli_jax.report.page import MOST_FLIGHTS, Draw, Picture, filled, picture
from heli_jax.vehicle import Constant, of_helicopter
from heli_jax.versions import versions


def write_report(
    directory: Path,
    analysis: Analysis,
    title: str,
    vehicle_constants: Mapping[str, Constant],
    made: Origin | None = None,
    *,
    png: bool = False,
) -> list[str]:
    """Write report.html and figures/NAME.svg, and return the figures' names.

    The page loads nothing from outside. Text from logs and configurations is escaped.

    Args:
        directory: existing output directory.
        vehicle_constants: constants of the vehicle file, by name.
        made: command, configuration and files beside the page; default this process without files.
        png: write figures/NAME.png too.

    Raises:
        OSError: the directory is not writable.
    """
    fit, problem, baseline, supplementary = analysis
    folder = directory / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    numbers = Numbers()
    # Figures are drawn one by one to save memory.
    pictures = [
        picture(name, draw, numbers, folder=folder, png=png)
        for name, draw in drawings(analysis).items()
    ]
    first = None
    if (worst := worst_output(fit)) is not None:
        first = picture("overview", lambda: figures.overview(*worst, problem.model), numbers)
    statements = lines(fit)
    page = filled(
        "report.html.j2",
        title=title,
        state=max(reversed(statements), key=lambda s: _LEVELS.index(s.level)).word,
        fit=fit,
        problem=problem,
        baseline=baseline,
        more=supplementary,
        card=card(fit, supplementary.responses),
        summary=summary,
        # The template calls this module for its rows.
        lines=statements,
        severe=most_severe(fit.findings),
        limits={
            "factor": f"{FACTOR:g}",
            "explained": percent(EXPLAINED, 0),
            "nearly_white": percent(NEARLY_WHITE, 0),
            "expected": f"{EXPECTED:g}",
        },
        remark=model_remark(problem),
        tables=tables,
        constants=tables.constants(problem, vehicle_constants),
        versions=versions(),
        origin=made or origin(),
        unshown=max(0, len(fit.signals) - MOST_FLIGHTS),
        overview=first,
        pictures={
            group: [(p, caption(p)) for p in pictures if p.name.startswith(group)]
            for group in GROUPS
        },
        numbers=numbers.content(),
    )
    (directory / "report.html").write_text(page, encoding="utf-8")
    return [p.name for p in pictures]


# A group must not be a prefix of another.
GROUPS = {
    "response": "From the top, over time: measured and simulated signals, residual, inputs.",
    "residual": "From the top, by lag: correlation of the residual with itself, then with each "
    "input; for white noise 99 % of the lags lie in the band.",
    "match": "From the top: gain and phase of model and data with 95 % intervals, and of the "
    "recursive least squares without their hold; partial coherence of the data; data "
    "over model. Grey: envelopes of differences that pilots of full-size aeroplanes did "
    "not notice (Wood and Hodgkinson, 1980).",
    "held": "The same for all held-out flights together: gain and phase of model and data with "
    "95 % intervals, partial coherence of the data, and data over model.",
    "rls": "Each coefficient over the record: a trustworthy one becomes constant.",
}
"""Caption after a figure's title, by the beginning of its name."""


def worst_output(fit: Fit) -> tuple[Signals, str] | None:
    """Return the fitted flight and output with the smallest VAF; None if none moves."""
    shares = {
        (i, output): metrics(measured, s.simulated[output]).vaf
        for i, s in enumerate(fit.signals)
        if not s.hold_out
        for output, measured in s.measured.items()
    }
    known = {place: vaf for place, vaf in shares.items() if np.isfinite(vaf)} or shares
    if not known:
        return None
    i, output = min(known, key=lambda place: known[place])
    return fit.signals[i], output


def drawings(analysis: Analysis) -> dict[str, Draw]:
    """Return functions that draw the figures, by file name."""
    later = functools.partial
    fit, problem, baseline, supplementary = analysis
    model, drawings = problem.model, dict[str, Draw]()
    parts = _parts([s.flight for s in fit.signals])
    for i in _drawn([s.hold_out for s in fit.signals]):
        s, part = fit.signals[i], parts[i]
        for output in s.measured:
            drawings[f"response{part}_{output}"] = later(figures.response, s, output, model)
            if not s.hold_out:
                drawings[f"residual{part}_{output}"] = later(
                    figures.residual_correlation,
                    s,
                    output,
                    fit.whiteness.get(f"{s.flight}/{output}"),
                )
    if (responses := supplementary.responses) is not None:
        about = (
            f"model linearised about {responses.about}" if responses.about else "continuous model"
        )
        for group, pairs, whose in (
            ("match", responses.pairs, "flights together"),
            ("held", responses.held_out, "flights held out together"),
        ):
            note = f"{about}; data without the hold of the input, {whose}"
            for pair in pairs:
                unit = figures.quotient(
                    naming.unit(model.Outputs, pair.output), naming.unit(model.Inputs, pair.input)
                )
                name = f"{group}_{pair.output}-{pair.input}"
                of = baseline and (baseline.input, baseline.output)
                rls = baseline if group == "match" and of == (pair.input, pair.output) else None
                drawings[name] = later(figures.match, pair, unit, note, rls)
    if baseline is not None:
        # Time of the flight's first sample in the log [s].
        start = next((s.log_start for s in fit.signals if s.flight == baseline.flight), None)
        drawings["rls"] = later(figures.rls_history, baseline, log_start=start)
    return drawings


def _drawn(hold_out: list[bool]) -> list[int]:
    """Return the indices of the flights with figures, at most half of them held out."""
    held = [i for i, out in enumerate(hold_out) if out][: MOST_FLIGHTS // 2]
    fitted = [i for i, out in enumerate(hold_out) if not out][: MOST_FLIGHTS - len(held)]
    rest = [i for i in range(len(hold_out)) if i not in {*held, *fitted}]
    return sorted([*fitted, *held, *rest[: MOST_FLIGHTS - len(held) - len(fitted)]])


def _parts(flights: list[str]) -> list[str]:
    """Return the parts of file names by flight; empty for one flight."""
    if len(flights) == 1:
        return [""]
    # Names of logs may contain any letters; the number makes them unique.
    return [
        f"_{i + 1}_{re.sub('[^A-Za-z0-9]+', '-', f).strip('-')[:40]}".rstrip("_")
        for i, f in enumerate(flights)
    ]


def caption(picture: Picture) -> str:
    """Return the caption of a figure, with the name of its files."""
    [words] = [words for begins, words in GROUPS.items() if picture.name.startswith(begins)]
    return f"{picture.title}. {words} (figures/{picture.name}.svg)"


_LEVELS = ("none", "good", "warning", "bad")


class Line(NamedTuple):
    """One of the three statements at the head of the page."""

    level: str
    """One of `_LEVELS`."""
    word: str
    text: str
    """One sentence."""


def lines(fit: Fit) -> tuple[Line, Line, Line]:
    """Return the statements on convergence, identifiability and adequacy."""
    if fit.status == "not-converged":
        stopped = "The optimiser stopped before an optimum: these numbers are not a result."
        return (
            Line("bad", "Not converged", stopped),
            Line("none", "Identifiability not judged", "The analysis needs an optimum."),
            Line("none", "Adequacy not judged", "The tests need an optimum."),
        )
    best, runs = sum(row.optimum == 1 for row in fit.starts), len(fit.starts)
    reached = f"The optimiser reached an optimum in {fit.steps} steps."
    if runs > 1:
        reached = f"{best} of {runs} searches ended at this optimum, the best one."
    text = " ".join(filter(None, (fit.verdict.text, fit.distrust)))
    determined = Line("good", "Identifiable", text)
    if fit.status == "not-identifiable" or fit.not_identifiable:
        determined = Line("bad", "Not identifiable", text)
    elif fit.untrusted:
        determined = Line("warning", "Identifiable, not trusted", text)
    adequate = Line("bad", "Not adequate", f"{'; '.join(fit.reasons_against)}.")
    if fit.adequate:
        doubts = fit.doubts
        statements = [doubts[0] if doubts else "No test contradicts the model"]
        for agreement, how in (
            (fit.metrics, "simulated"),
            (fit.one_step, "one step ahead"),
            (fit.validation, "held out"),
        ):
            shares = {n: m.vaf for n, m in agreement.items() if math.isfinite(m.vaf)}
            if shares:
                worst = min(shares, key=lambda n: shares[n])
                words = f"VAF of {worst} {vaf_percent(shares[worst])} {how}"
                poor = shares[worst] < 0 and not fit.adequacy.ahead
                statements.append(f"{words}, worse than its mean" if poor else words)
        kind, word = ("warning", "Adequate, with doubts") if doubts else ("good", "Adequate")
        adequate = Line(kind, word, f"{'; '.join(statements)}.")
    return Line("good", "Converged", reached), determined, adequate


def model_remark(problem: Problem) -> str:
    """Return a remark on inertias of the paper's model; empty for other models."""
    if not of_helicopter(problem.model.Params):
        return ""
    factor = float(np.asarray(problem.vehicle.cyclic_moment))
    return (
        "Ixx and If are numbers of the paper's model, not of the vehicle: eqs 14-15 have the "
        f"factor 1/2 (cyclic_moment, here {factor:g}), but blade-element theory averaged over a "
        "turn gives 1/8 for two blades, and the estimated inertia is proportional to it. Keep "
        "this in mind when you compare it with a measured inertia."
    )
