"""Comparison of several fits: estimates and differences, agreement, verdicts; and its page."""

import math
import os
import urllib.parse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from heli_jax.errors import InputError
from heli_jax.finding import Finding, note, sentences
from heli_jax.identification.methods import objective_of
from heli_jax.identification.result import Estimate
from heli_jax.identification.validation.metrics import FAR, Metrics, diverges
from heli_jax.numbers import NOTHING, number, vaf_percent
from heli_jax.report.origin import origin
from heli_jax.report.page import filled
from heli_jax.report.saved_fit import SavedFit, load_fit
from heli_jax.report.style import pretty
from heli_jax.report.tables import Table
from heli_jax.summaries import as_text, cells_of

if TYPE_CHECKING:
    import pandas as pd

NOT_CONVERGED = "not converged"
_METRICS: tuple[tuple[str, str, Callable[[float | None], str]], ...] = (
    ("VAF", "vaf", vaf_percent),
    ("fit", "nrmse_fit_percent", lambda v: vaf_percent(None if v is None else v / 100)),
    ("TIC", "tic", lambda v: number(v, 3)),
)


class ComparedRuns(NamedTuple):
    """Fits with unique names."""

    labels: tuple[str, ...]
    runs: tuple[SavedFit, ...]

    @property
    def estimates(self) -> Table:
        """Estimates and sd by run, with differences from the first run."""
        first = self.labels[0]
        several = [f"{label} - {first} [sd]" for label in self.labels[1:]]
        rows, of_runs = [], self._by_run()
        for name in _in_order(of_runs):
            estimates = [of_run.get(name) for of_run in of_runs]
            units = dict.fromkeys(pretty(e.unit) for e in estimates if e is not None)
            pairs = list(zip(estimates, self.runs, strict=True))
            cells = [_measured(e, run) for e, run in pairs]
            first_one, *others = (e if _converged(run) else None for e, run in pairs)
            apart = [_difference(first_one, other) for other in others]
            rows.append((name, *cells, *apart, ", ".join(units)))
        return Table(("parameter", *self.labels, *several, "unit"), rows)

    def _by_run(self) -> list[dict[str, Estimate]]:
        """Return each run's estimates, combinations and shared nuisances.

        The nuisances are gains, the time shift and the disturbance.
        """
        by_run = []
        for run in self.runs:
            # A nuisance of one flight is named FLIGHT/NAME.
            shared = {n: e for n, e in run.nuisance.items() if "/" not in n}
            by_run.append({**run.estimates, **_combinations(run), **shared})
        return by_run

    @property
    def agreement(self) -> Table:
        """VAF, NRMSE fit and Theil's coefficient by output and run, also of held-out flights.

        Runs of the same samples are also compared by AIC.
        """
        rows = []
        for held_out in (False, True):
            of = [run.validation if held_out else run.metrics for run in self.runs]
            for output in _in_order(of):
                for words, key, text in _METRICS:
                    where = "held out" if held_out else "fitted"
                    cells = (_agreement(m.get(output), key, text) for m in of)
                    rows.append((output, where, words, *cells))
        # Likelihoods are comparable only for the same samples in time.
        first, *others = {_samples(run) for run in self.runs}
        if first and not others and all(map(_converged, self.runs)):
            aic = [run.content["aic"] for run in self.runs]
            above = (number(round(value - min(aic), 1), 3) for value in aic)
            rows.append(("all", "fitted", "AIC above the best", *above))
        return Table(("output", "flights", "metric", *self.labels), rows)

    @property
    def verdicts(self) -> Table:
        """Convergence, identifiability and adequacy by run."""
        rows = [
            (
                label,
                run.model,
                method_of(run),
                run.status,
                "No optimum was reached."
                if run.status == "not-converged"
                else " ".join(filter(None, (run.verdict, run.distrust))),
                run.adequacy,
            )
            for label, run in zip(self.labels, self.runs, strict=True)
        ]
        head = ("run", "model", "method", "optimiser", "what the data determine", "adequate")
        return Table(head, rows)

    @property
    def notes(self) -> tuple[Finding, ...]:
        """Notes and doubts; their subjects are labels of runs."""
        words = (
            "± is one standard deviation (sd); a 95 % interval is about twice as wide. "
            "Differences are from the first run, in the joint sd of independent estimates. Runs "
            "that share a log have correlated estimates, which by chance differ less."
        )
        notes, first = [note("compared.joint-sd", words)], self.runs[0]
        for label, run in zip(self.labels, self.runs, strict=True):
            doubts = {}
            if not _converged(run):
                doubts["not-converged"] = " did not converge: its numbers are not a result."
                if run is first:
                    doubts["not-converged"] += (
                        " Name a converged run first: differences are from the first."
                    )
            elif run.distrust:
                doubts["not-trusted"] = f": {run.distrust}"
            if _converged(run) and run.adequate is False:
                doubts["not-adequate"] = " is not adequate: its intervals may be too narrow."
            elif _converged(run) and run.overconfident:
                doubts["overconfident"] = ": its sd are too small: its residuals are not white."
            notes += [
                Finding(f"compared.{what}", "doubt", f"{label}{words}", subjects=(label,))
                for what, words in doubts.items()
            ]
        return tuple(notes)

    def to_dataframe(self) -> "pd.DataFrame":
        """Return a row per run and parameter or combination; NaN if not identifiable or not
        converged.
        """
        from heli_jax.exports import runs_frame

        none = {"sd": None, "lower95": None, "upper95": None}
        usable = (
            of_run if _converged(run) else {name: e._replace(**none) for name, e in of_run.items()}
            for run, of_run in zip(self.runs, self._by_run(), strict=True)
        )
        return runs_frame(dict(zip(self.labels, usable, strict=True)))

    def to_csv(self) -> str:
        """Return `to_dataframe` as CSV."""
        return self.to_dataframe().to_csv(index=False, lineterminator="\n")

    def __repr__(self) -> str:
        head, rows = self.estimates
        title = f"{len(self.runs)} runs: {', '.join(self.labels)}"
        return as_text(title, head, rows, sentences(self.notes))


def compare_runs(runs: Sequence[str | Path | SavedFit]) -> ComparedRuns:
    """Compare fits.

    Args:
        runs: run directories, or results of `load_fit`; at least two. Differences are from the
            first.

    Raises:
        InputError: fewer than two, or a directory contains no fit.
    """
    if len(runs) < 2:
        raise InputError(f"compare: expected two runs at least, got {len(runs)}")
    fits = tuple(run if isinstance(run, SavedFit) else load_fit(run) for run in runs)
    return ComparedRuns(_labels([fit.directory for fit in fits]), fits)


def _labels(directories: Sequence[Path]) -> tuple[str, ...]:
    """Return the shortest unique ends of paths."""
    paths = [d.absolute().parts for d in directories]
    for depth in range(1, max(map(len, paths)) + 1):
        labels = ["/".join(p[-depth:]) for p in paths]
        if len(set(labels)) == len(labels):
            return tuple(labels)
    # The same directory may occur twice.
    return tuple(f"{p[-1]} ({i})" for i, p in enumerate(paths, 1))


def _samples(run: SavedFit) -> tuple[Any, ...]:
    """Return what identifies the fitted samples; empty if unknown, or if not fitted in time."""
    flights = [f for f in run.content.get("data") or [] if not f.get("hold_out")]
    known = "aic" in run.content and flights and all(f.get("sha256") for f in flights)
    if not known or objective_of(run.method).noise_model == "spectrum":
        return ()
    facts = ((f["sha256"], *f.get("window", ()), f.get("dt")) for f in flights)
    return run.content.get("n_samples"), *facts


_NUMBERS = ("value", "sd", "lower95", "upper95")


def _combinations(run: SavedFit) -> dict[str, Estimate]:
    """Return the combinations that a fit determines; none if it did not converge."""
    every = run.content.get("determined_combinations") or ()
    known = (c for c in every if all(c.get(key) is not None for key in _NUMBERS))
    return {
        c["name"]: Estimate(
            c["value"], c["sd"], c["lower95"], c["upper95"], "SI", math.nan, 0.0, at_bound=False
        )
        for c in known
        if _converged(run)
    }


# Any: mappings of estimates or of metrics by name.
def _in_order(mappings: Any) -> list[str]:
    return list(dict.fromkeys(name for mapping in mappings for name in mapping))


def method_of(run: SavedFit) -> str:
    """Return the method, with the inputs replaced by their instruments."""
    inputs = run.content.get("instruments") or ()
    return f"{run.method} by instrument ({', '.join(inputs)})" if inputs else run.method


def _converged(run: SavedFit) -> bool:
    return run.status != "not-converged"


def _measured(e: Estimate | None, run: SavedFit) -> str:
    if e is None:
        return NOTHING
    if not _converged(run):
        return NOT_CONVERGED
    if e.sd is None and e.at_bound and e.value == 0.0:
        return "0"  # an insignificant disturbance
    value, sd, interval = cells_of(e)
    if not sd:
        return value
    return f"{value} ({interval})" if e.lower95 is None else f"{value} ± {sd}"


def _difference(first: Estimate | None, other: Estimate | None) -> str:
    if first is None or other is None or first.sd is None or other.sd is None:
        return NOTHING
    joint = math.hypot(first.sd, other.sd)
    if first.unit != other.unit or not joint:
        return NOTHING
    text = f"{(other.value - first.value) / joint:+.1f}".replace("-", "−")
    return "0.0" if text in ("+0.0", "−0.0") else text


def _agreement(m: Metrics | None, key: str, text: Callable[[float | None], str]) -> str:
    if m is not None and diverges(m, FAR):
        return "diverges"
    return text(getattr(m, key, None))


_FILES = ("report.html", "fit.json", "signals.csv", "config.yaml")


def write_page(path: Path, compared: ComparedRuns) -> None:
    """Write the self-contained page."""

    def link(file: Path) -> str:
        return urllib.parse.quote(os.path.relpath(file.absolute(), path.absolute().parent))

    named = list(zip(compared.labels, compared.runs, strict=True))
    page = filled(
        "compared.html.j2",
        labels=compared.labels,
        tables=[
            ("Estimates", compared.estimates),
            ("Verdicts", compared.verdicts),
            ("Agreement", compared.agreement),
        ],
        notes=sentences(compared.notes),
        # Paths are relative, so that page and runs can be moved together.
        files=[
            (label, [(n, link(run.directory / n)) for n in _FILES if (run.directory / n).is_file()])
            for label, run in named
        ],
        configs=[
            (label, config.read_text(encoding="utf-8"))
            for label, run in named
            if (config := run.directory / "config.yaml").is_file()
        ],
        origin=origin(),
    )
    path.write_text(page, encoding="utf-8")
