"""What the commands print and write."""

import contextlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heli_jax import config as configuration
from heli_jax import run_directory
from heli_jax.flights import write as tables
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.equation_error.first_guess import EquationErrorStart
from heli_jax.identification.fit import Check, Estimate
from heli_jax.identification.identifiability.verdict import Combination, Verdict
from heli_jax.identification.validation.expected_accuracy import GUESSED, too_good
from heli_jax.identification.validation.finding import Finding
from heli_jax.identification.validation.metrics import Metrics, diverges
from heli_jax.numbers import rounded
from heli_jax.report import files
from heli_jax.report import tables as report_tables
from heli_jax.report.card import card, summary
from heli_jax.workflow import FitRun

if TYPE_CHECKING:
    from heli_jax.generate import Simulated
    from heli_jax.sweeps.run import Progress


def print_fit(run: FitRun) -> None:
    """Verdict, estimates, agreement and baseline on standard output."""
    problem, fit, supplementary = run.problem, run.fit, run.supplementary
    judged = "judged where it stopped: " if fit.status == "not-converged" else ""
    arrived = "converged, not-identifiable" if fit.status == "not-identifiable" else fit.status
    # Did the optimiser arrive; what do the data determine; is the model adequate.
    print(f"{arrived}: {judged}{fit.verdict.text} adequate: {report_tables.adequate(fit)}")
    note = files.whiteness_note(fit)
    for line in ([note] if note else []) + list(fit.notes):
        print(f"! {line}")
    # Nuisance parameters of a single flight ('flight/bias') are many and of interest to few: they
    # stand in fit.json and the report.
    shown = {**fit.estimates, **{n: e for n, e in fit.nuisance.items() if "/" not in n}}
    rows = [_row(name, e) for name, e in shown.items()]
    head = ("parameter", "estimate", "sd", "95 % interval", "unit", "prior share")
    print_table((*head[:3], fit.interval, *head[4:]), rows)
    if note := report_tables.prior_note(problem, fit):
        print(f"! {note}")
    for c in fit.verdict.combinations:
        print(_determined(c))
    if supplementary.intervals is not None:
        table = report_tables.intervals(supplementary.intervals, fit)
        print_table(table.head, table.rows)
        for sentence in supplementary.intervals.sentences:
            print(f"! {sentence}")
    # From the weakest claim to the strongest: simulation and prediction of the fitted flights, then
    # of those held out, where a model that was fitted too closely shows.
    for name, m in fit.metrics.items():
        _print_agreement(f"{name}, simulated", m)
    for name, m in fit.one_step.items():
        _print_agreement(f"{name}, one step ahead", m)
    for name, m in fit.validation.items():
        _print_agreement(f"{name}, held out, simulated", m)
    for name, m in fit.validation_free_run.items():
        # An unstable machine simulated in one piece leaves any record: numbers would say nothing.
        if diverges(m):
            print(f"{name}, held out, simulated in one piece: diverges")
        else:
            _print_agreement(f"{name}, held out, simulated in one piece", m)
    for name, m in fit.one_step_validation.items():
        _print_agreement(f"{name}, held out, one step ahead", m)
    if (responses := report_tables.responses(fit)) is not None:
        print_table(responses.head, responses.rows)
    if problem.first_guess is not None:
        _print_first_guess(problem.first_guess)
    print(f"acceptance card: {summary(card(problem, fit))}")
    if supplementary.choice is not None:
        compared = report_tables.choice(supplementary.choice)
        print_table(compared.head, compared.rows)
        for sentence in supplementary.choice.sentences:
            print(sentence)
    if run.baseline is not None:
        _print_baseline(run.baseline)
    if run.directory is not None:
        print(f"report: {run.directory / 'report.html'}")


def run_compatibility(
    config: str, out: str | None, overrides: list[str], say: Callable[[str], None]
) -> bool:
    """Compare a log's sensors and print what was found; whether they agree.

    Args:
        config: the configuration.
        out: a new directory; runs/NAME-DATE-TIME unless given.
        overrides: of `--set`.
        say: for words as the work goes on.

    Raises:
        InputError: a log or something of the configuration is wrong.
    """
    # Here: of all commands only this one needs it.
    from heli_jax import compatibility

    place = run_directory.default_directory(Path(config)) if out is None else Path(out)
    found = compatibility.run_compatibility(config, place, overrides=overrides, progress=say)
    print(found.verdict)
    for line in found.doubts:
        print(f"! {line}")
    print_table(*compatibility.table(found))
    print(
        "R2 of what is reconstructed: "
        + ", ".join(f"{n} {r:.4f}" for n, r in found.r_squared.items())
    )
    print(f"corrections: {place / compatibility.FILE}")
    print(f"report: {place / 'report.html'}")
    return found.compatible


def _print_first_guess(guess: EquationErrorStart) -> None:
    print("Where the fit began, by equation error (no result):")
    for table in (report_tables.first_guess(guess), report_tables.selection_steps(guess)):
        if table.rows:
            print_table(table.head, table.rows)


def _determined(c: Combination) -> str:
    """`determined: a/Ixx = 212.61, sd 0.36, 95 % interval 211.90 to 213.32`"""
    value, sd = rounded(c.value, c.sd)
    return f"determined: {c.name} = {value}, sd {sd}, 95 % interval {_range(c)}"


def _range(estimate: Estimate | Combination) -> str:
    """An interval to the digits that its sd leaves; ends far from the value to three."""
    value, sd = estimate.value, estimate.sd
    assert sd is not None
    ends = (estimate.lower95, estimate.upper95)
    shown = []
    for end in ends:
        assert end is not None
        # Where an interval spans powers of ten its ends have digits of their own.
        near = abs(end - value) < _NEAR * sd and abs(end) > abs(value) / _NEAR
        shown.append(rounded(end, sd)[0] if near or end == 0 else f"{end:.3g}")
    return f"{shown[0]} to {shown[1]}"


_NEAR = 10.0
"""standard deviations from the value, or share of it, up to which an end shares its digits"""


def _print_agreement(what: str, m: Metrics) -> None:
    print(f"{what}: VAF {m.vaf:.5f}, fit {m.nrmse_fit_percent:.1f} %, TIC {m.tic:.4f}")


def _print_baseline(b: Baseline) -> None:
    ratios = ", ".join(f"{n} = {v:.4g}" for n, v in b.combinations.items())
    vaf = f"VAF {b.metrics.vaf:.5f}" if math.isfinite(b.metrics.vaf) else "its simulation diverges"
    print(f"RLS (order {b.order}, {b.output}): {vaf}" + (f"; {ratios}" if ratios else ""))
    for sentence in b.sentences:
        print(f"  ! {sentence}")


def _row(name: str, e: Estimate) -> tuple[str, ...]:
    # A parameter that is not identifiable keeps its value in fit.json; a number here would be read
    # as an estimate.
    if e.sd is None or e.lower95 is None or e.upper95 is None:
        return (name, "not determined", "", "", e.unit, f"{e.prior_share:.2f}")
    at_bound = " (at bound)" if e.at_bound else ""
    value, sd = rounded(e.value, e.sd)
    return (name, value + at_bound, sd, _range(e), e.unit, f"{e.prior_share:.2f}")


def print_table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """A table on standard output, its columns as wide as they need."""
    # Imported here, not above: rich takes a tenth of a second, which `heli-jax --help` has not.
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, name in enumerate(head):
        table.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(_escaped(cell) for cell in row))
    # In a pipe rich assumes 80 columns and cuts off what is wider.
    width = None if sys.stdout.isatty() else 120
    Console(file=sys.stdout, highlight=False, width=width).print(table)


def _escaped(text: str) -> str:
    from rich.markup import escape

    # '[deg]' in a unit or a signal's name is markup to rich, and would vanish.
    return escape(text)


def print_check(check: Check) -> None:
    """The identifiability at the initial guess, on standard output."""
    verdict = check.verdict
    # The fit judges at its estimates, and need not agree: sensitivities move with the parameters.
    print("At the start values (the fit judges at its estimates, which may differ):")
    _print_verdict(verdict)
    rows = []
    for i, name in enumerate(verdict.names):
        # The covariance is that of the logarithms: its root is the relative sd.
        relative = math.sqrt(verdict.covariance[i, i])
        lacking = name in verdict.undetermined or name in verdict.without_effect
        expected = "not determined" if lacking else f"{100 * relative:.2g} %"
        rows.append((name, expected, f"{verdict.prior_share[name]:.2f}"))
    print_table(("parameter", "expected sd", "prior share"), rows)
    for name, sd in check.noise.items():
        guess = f" ({GUESSED})" if name in check.guessed else ""
        print(f"noise of {name}: {sd:.3g}{guess}")
    if sentence := too_good(np.sqrt(np.diag(verdict.covariance)), bool(check.guessed)):
        print(f"! {sentence}")
    for note in check.further_notes:
        print(f"! {note}")
    _print_findings(check.findings)


def _print_findings(findings: Sequence[Finding]) -> None:
    """Whether the log is enough, a line each, what is worst first."""
    if not findings:
        return
    print("\nIs this log enough?")
    for f in findings:
        print(f"{_MARKS[f.severity]} {f.topic}: {f.sentence}")


_MARKS = {"ok": " ", "doubt": "!", "refuse": "x"}


def _print_verdict(verdict: Verdict) -> None:
    print(verdict.text)
    values = ", ".join(f"{s:.3g}" for s in verdict.singular_values)
    print(
        f"rank {verdict.rank} of {len(verdict.names)} ({verdict.rank_without_priors} without "
        f"priors), condition number {verdict.condition:.3g}, singular values {values}"
    )
    for direction in verdict.null_directions:
        words = ", ".join(f"{n} {v:+.4f}" for n, v in direction.items())
        print(f"null direction (log coordinates): {words}")


def write_table(out: Path | None, columns: dict[str, np.ndarray]) -> None:
    """A table as CSV or Parquet at `out`, which appears whole or not at all, or as CSV on stdout.

    Raises:
        InputError: the place cannot be written to.
    """
    if out is None:
        tables.write_table(sys.stdout.buffer, columns)
        return
    with run_directory.whole_file(out, f"--out {out}") as temporary:
        tables.write_table(temporary, columns)


def write_view(out: Path, experiment: configuration.Experiment, simulated: "Simulated") -> None:
    """The page of what was simulated at `out`, which appears whole or not at all.

    Args:
        out: the HTML file to write.
        experiment: the configuration, of which the page shows the vehicle.
        simulated: the runs.

    Raises:
        InputError: the place cannot be written to.
    """
    # Imported here: no other command needs the page.
    from heli_jax.report.view import write_view as write

    title, params = experiment.path.stem, experiment.vehicle.params
    with run_directory.whole_file(out, f"--view {out}") as temporary:
        write(temporary, simulated.runs, simulated.model, params, title, simulated.notes)


@contextlib.contextmanager
def sweep_progress() -> Iterator["Callable[[Progress], None]"]:
    """What shows how far a sweep is, on standard error: a bar on a terminal, else now and then a
    line."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    # A bar in a log file is a line of carriage returns.
    if not sys.stderr.isatty():
        yield _Lines()
        return
    columns = (TextColumn("sweep"), BarColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("compiling", total=1.0)
        yield lambda p: bar.update(task, completed=p.done / p.total, description=_progress_words(p))


class _Lines:
    """A line at the first chunk, the last, and every ten seconds between."""

    def __init__(self) -> None:
        self.last = -math.inf

    def __call__(self, p: "Progress") -> None:
        now = time.monotonic()  # unlike time.time() it does not jump when a clock is set
        if p.done == p.total or now - self.last > 10.0:
            self.last = now
            print(f"heli-jax: sweep: {_progress_words(p)}", file=sys.stderr, flush=True)


def _progress_words(p: "Progress") -> str:
    words = f"{p.done} of {p.total} elements"
    # The first chunk compiles: a rate that contained it would foretell hours.
    if math.isnan(p.rate):
        return words
    words = f"{words}, {p.rate:.3g} a second"
    if p.done == p.total:
        return words
    left = max(0, round(p.remaining))
    return f"{words}, {left // 3600}:{left // 60 % 60:02d}:{left % 60:02d} left"


def _counted(elements: int) -> str:
    return "1 element" if elements == 1 else f"{elements} elements"


def print_sweep(out: Path) -> None:
    """The summary of a sweep on standard output."""
    # From the file, not from memory: a resumed sweep prints what all its runs have computed.
    totals = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    counts = {k: v for k, v in totals["status"].items() if v}
    words = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in counts.items())
    print(f"{_counted(totals['elements'])} of {totals['model']}: {words}")
    rows = []
    for name, result in totals["results"].items():
        numbers = [
            f"{result[k]:.4g}" if k in result else ""
            for k in ("min", "q05", "median", "q95", "max")
        ]
        error = totals.get("float32_error", {}).get(name)
        rows.append(
            (name, *numbers, result.get("unit", ""), "" if error is None else f"{error:.1g}")
        )
    # The last column only where the sweep compared single with double precision.
    head = ("result", "min", "5 %", "median", "95 %", "max", "unit", "float32 error")
    width = len(head) if "float32_error" in totals else len(head) - 1
    print_table(head[:width], [row[:width] for row in rows])
    for name, worst_ones in totals["worst"].items():
        element = worst_ones[0]
        at = ", ".join(f"{n} = {v:.4g}" for n, v in element["axes"].items())
        print(f"worst {name}: element {element['element']}, {at}")
    for note in totals["notes"]:
        print(f"! {note}")
    for name, result in totals["results"].items():
        # Quantiles are of the finite values alone: how many were not is part of the answer.
        apart = {"infinite": result.get("infinite", 0), "not a number": result.get("nan", 0)}
        if sum(apart.values()):
            words = " and ".join(f"{k} {what}" for what, k in apart.items() if k)
            of = result["n"] + sum(apart.values())
            print(f"! {name}: of {of} values {words}, which its line leaves out")
    if not totals["status"].get("ok"):
        print("! no element is ok: see docs/sweeps.md for what each status means")
    timing = totals["timing"]
    # A sweep that was resumed when all was there has computed nothing, and has no rate.
    if timing["computed_elements"]:
        print(
            f"{_counted(timing['computed_elements'])} in {timing['seconds']:.3g} s "
            f"({timing['elements_per_s']:.3g} a second, with compilation)"
        )
    print(f"store: {out / 'sweep.zarr'}")
