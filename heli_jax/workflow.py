"""Complete analyses as functions, for scripts, notebooks and the command line.

`load_config` reads a configuration; `run_fit` does what `heli-jax fit` does, `run_check` what
`heli-jax check` does. `load_fit` reads an earlier fit.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from heli_jax import config as configuration
from heli_jax import run_directory
from heli_jax.analysis.flight_responses import Settings
from heli_jax.config import Experiment
from heli_jax.config.frequency import missing_handling, requested_handling
from heli_jax.config.frequency_section import FrequencyConfig
from heli_jax.config.logs import log_notes
from heli_jax.errors import InputError, located, require_kind
from heli_jax.finding import Finding, note, without_repeats
from heli_jax.identification.equation_error.rls import Baseline, baseline
from heli_jax.identification.fit import check, fit, rates
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Check, Fit
from heli_jax.identification.select import (
    Choice,
    choose,
    compare_methods,
)
from heli_jax.identification.uncertainty.comparison import intervals
from heli_jax.report import files
from heli_jax.report.files import SupplementaryAnalyses
from heli_jax.stages import Note, recorded, stage
from heli_jax.yaml_file import as_yaml

# Receives progress messages. A logger would have to be set up in notebooks and captured by the
# command line.
type Say = Callable[[str], None]


# A named function, so that help() shows the default of `progress`.
def _silent(_: str) -> None:
    pass


@dataclass(frozen=True, eq=False)
class FitRun:
    """A fit with all results that its configuration asks for."""

    config: Experiment
    problem: Problem
    fit: Fit
    baseline: Baseline | None = None
    """Recursive least squares on the same data; None if it is off or fails."""
    supplementary: SupplementaryAnalyses = field(default_factory=SupplementaryAnalyses)
    """Model selection and further intervals, if the configuration asks for them."""
    directory: Path | None = None
    """Directory of the report, once it is written."""
    began: float = field(default_factory=time.perf_counter)
    """Start of the work, by `time.perf_counter` [s]."""

    # Each call draws a new figure, since a caller could change a stored one. Any, since only
    # `report` imports matplotlib.
    def figure(self, name: str) -> Any:
        """Draw a figure of the report as a matplotlib Figure: `response_OUTPUT`,
        `match_OUTPUT-INPUT`, `rls`, ...

        Raises:
            ValueError: the report has no figure of that name; the message lists the names.
        """
        # matplotlib takes a second to import, and a fit without report does not need it.
        from heli_jax.report.fit_page import Analysis, drawings
        from heli_jax.report.style import styled

        shown = _with_responses(self) if name.startswith(("match", "held")) else self.supplementary
        draw = drawings(Analysis(self.fit, self.problem, self.baseline, shown))
        if name not in draw:
            raise ValueError(f"figure: expected one of {', '.join(draw)}, got {name!r}")
        return styled(draw[name])

    def __repr__(self) -> str:
        where = "" if self.directory is None else f"\n  report: {self.directory / 'report.html'}"
        return f"FitRun of {self.config.path}: {self.fit!r}{where}"


def load_config(path: str | Path, overrides: Sequence[str] | Mapping[str, Any] = ()) -> Experiment:
    """Read and validate a configuration, its model and its vehicle; no log is opened yet.

    Args:
        path: the configuration (YAML); paths in it are relative to its folder.
        overrides: replacements for values of the file: `{"fit.free.a.start": 5}`, or as on the
            command line, `["fit.free.a.start=5"]`.

    Raises:
        InputError: the file or an override is wrong.
    """
    return configuration.load(path, overrides)


def run_fit(
    config: Experiment | str | Path,
    out: str | Path | None = None,
    *,
    progress: Say = _silent,
    began: float | None = None,
) -> FitRun:
    """Fit a configuration's flights, with the baseline, intervals and model selection it asks for.

    Args:
        config: result of `load_config`, or the path of a configuration.
        out: directory for the report (see `write_report`); default: no report.
        progress: called with progress messages and the assumptions of the log's reader.
        began: start of the work, by `time.perf_counter` [s]; default: now.

    Raises:
        InputError: a log or the configuration is wrong, a log is too slow for the model at its
            start values (docs/enough.md), or `out` cannot be written.
    """
    began = time.perf_counter() if began is None else began
    if out is not None:
        out = run_directory.free_directory(Path(out))  # fails before the work, not after it
    with recorded() as seconds:
        seconds["loading"] = time.perf_counter() - began
        run = _fit_run(config, progress, began)
        kept = None if out is None or not _takes_long(run) else Path(out)
        if kept is not None:
            with stage("writing the fit", name="report before further intervals"):
                _write(_interrupted(run), kept, page=False)
            progress(f"the fit is in {out}; further intervals will be added to it")
        further = _supplementary(run.config, run.problem, run.fit, progress)
        run = replace(run, supplementary=further)
        run.fit.timing.update(seconds)
    if out is None:
        return run
    progress("writing the report")
    with stage("writing the report"):
        return _write(run, Path(out), replaces=kept is not None)


def _takes_long(run: FitRun) -> bool:
    """True if the configuration asks for many further fits."""
    options = run.config.config.fit
    assert options is not None
    further = options.intervals
    return bool(
        further.profile or further.bootstrap or further.nuts or options.compare or options.also
    )


def _interrupted(run: FitRun) -> FitRun:
    """Return the run as it is if an interrupt ends its further analyses."""
    words = "The run was interrupted before the further intervals, models or methods requested."
    findings = (*run.fit.findings, note("uncertainty.interrupted", words))
    # The times of the run continue.
    return replace(run, fit=replace(run.fit, findings=findings, timing=dict(run.fit.timing)))


def _fit_run(config: Experiment | str | Path, progress: Say, began: float) -> FitRun:
    """Run the fit and the baseline of `run_fit`."""
    with stage("reading the log", name="reading"):
        config = config if isinstance(config, Experiment) else load_config(config)
        # A fit that ignores the study would look like the study's result.
        if config.config.study is not None:
            raise InputError(
                f"{config.path}: study: needs many fits, expected heli_jax.run_study, or study: "
                "null"
            )
        problem = configuration.problem(config)
    # Report before the fit, so that a wrong unit or hold is seen while the fit runs.
    for one in reading_notes(problem):
        progress(Note(one.sentence))
    options = config.config.fit
    assert options is not None  # `problem` refuses a configuration without fit
    # `fit` does not know the file that its messages need
    with located(f"{config.path}: fit"):
        # Refuse as `check` does. The estimates would look valid.
        for finding in rates(problem):
            if finding.severity == "refuse":
                raise ValueError(finding.sentence)
        with stage("fit"):
            fitted = fit(
                problem,
                starts=options.starts,
                seed=options.seed,
                max_steps=options.max_steps,
                progress=progress,
            )
    with stage("recursive least squares", name="rls"):
        rls = _baseline(config, problem, fitted, progress)
    return FitRun(config, problem, fitted, rls, began=began)


def run_check(config: Experiment | str | Path, *, progress: Say = _silent) -> Check:
    """Analyse the identifiability for a configuration's flights, before any fit.

    Args:
        config: result of `load_config`, or the path of a configuration.
        progress: called with the assumptions of the log's reader.

    Raises:
        InputError: a log or the configuration is wrong.
    """
    config = config if isinstance(config, Experiment) else load_config(config)
    problem = configuration.problem(config)
    notes = reading_notes(problem)
    for one in notes:
        progress(Note(one.sentence))
    with located(f"{config.path}: fit"), stage("what the log can determine"):
        return replace(check(problem), log_notes=tuple(notes))


def reading_notes(problem: Problem) -> list[Finding]:
    """Return the notes of the logs' readers, and notes on the origin of estimated start values."""
    guess = problem.first_guess
    return without_repeats((*log_notes(problem.flights), *(guess.findings if guess else ())))


def _baseline(config: Experiment, problem: Problem, fitted: Fit, progress: Say) -> Baseline | None:
    options = config.config.rls
    if options is None:
        return None
    progress("recursive least squares")
    # A failed baseline must not stop the fit. The record may be too short, or the model unsuitable.
    estimate = None
    try:
        estimate = baseline(
            config.model,
            config.vehicle.params,
            problem.training[0],  # RLS takes one record, as in the paper
            order=options.order,
            forgetting=options.forgetting,
        )
    except ValueError as e:
        progress(Note(f"no baseline: {e}"))
    return estimate


def _supplementary(
    config: Experiment, problem: Problem, fitted: Fit, progress: Say
) -> SupplementaryAnalyses:
    """Compute further intervals and model selection, if the configuration asks for them."""
    options = config.config.fit
    assert options is not None
    requested, further, choice, methods = options.intervals, None, None, None
    if requested.profile or requested.bootstrap or requested.nuts:
        with located(f"{config.path}: fit"):
            further = intervals(
                fitted,
                profiles=requested.profile,
                runs=requested.bootstrap,
                draws=requested.nuts,
                seed=options.seed,
                progress=progress,
            )
    # Each is a stage of its own, since any of them may take long.
    if options.compare:
        with stage("other models"):
            choice = compare_models(config, problem, progress=progress)
    if options.also:
        with stage("other methods"):
            methods = compare_methods(
                fitted,
                configuration.by_other_methods(config, problem),
                starts=options.starts,
                seed=options.seed,
                max_steps=options.max_steps,
                progress=progress,
            )
    return SupplementaryAnalyses(choice, further, methods=methods)


def compare_models(
    config: Experiment | str | Path, problem: Problem | None = None, *, progress: Say = _silent
) -> Choice:
    """Fit the models of `fit.compare` and the configuration's, and compare them by AIC, BIC and
    likelihood.

    Args:
        config: result of `load_config`, or the path of a configuration.
        problem: the configuration's problem if it exists (`FitRun.problem`), which saves reading
            the logs again.
        progress: called with progress messages.

    Raises:
        InputError: no axis of the model can be disturbed, or a model cannot be fitted.
    """
    config = config if isinstance(config, Experiment) else load_config(config)
    # All models use the same flights, since likelihoods of different data are not comparable.
    candidates = configuration.candidate_models(config, problem or configuration.problem(config))
    with located(f"{config.path}: fit"):
        return choose(candidates.problems, candidates.nested, progress=progress)


def write_report(run: FitRun, out: str | Path, *, page: bool = True) -> FitRun:
    """Write a fit's run directory: config.yaml, fit.json, signals.csv, report.html, figures/.

    It also writes posterior.nc and bootstrap.nc if there are NUTS draws and bootstrap samples. The
    directory appears complete or not at all. Returns the run with `directory` set to `out`, or to a
    numbered sibling, with a warning, if `out` exists.

    Args:
        run: result of `run_fit`.
        page: False for no page and no figures, which take seconds.

    Raises:
        InputError: `out` cannot be written to, or the extra `bayes` is missing.
        TypeError: `run` is no FitRun.
    """
    require_kind("run", run, FitRun, "a FitRun, as heli_jax.run_fit(config) returns it")
    return _write(run, run_directory.free_directory(Path(out)), page=page)


def _write(run: FitRun, out: Path, *, page: bool = True, replaces: bool = False) -> FitRun:
    """Write the run directory."""
    from heli_jax.report.fit_page import Analysis
    from heli_jax.report.fit_page import write_report as write_page
    from heli_jax.report.origin import origin
    from heli_jax.report.sample_files import sample_files, write_samples

    started = time.perf_counter()
    # Before the figures, since a configuration that cannot be written fails at once.
    text = as_yaml(configuration.resolved(run.config))
    vehicle, extra = run.config.vehicle, _with_responses(run) if page else run.supplementary
    with run_directory.whole(out, replaces=replaces) as folder:
        (folder / "config.yaml").write_text(text, encoding="utf-8")
        files.write_signals(folder / "signals.csv", run.fit.signals)
        title = run.config.path.stem
        analysis = Analysis(run.fit, run.problem, run.baseline, extra)
        sampled = sample_files(extra.intervals)
        corrections = ("compatibility.yaml",) if extra.sensors else ()
        made = origin(text, ("config.yaml", "fit.json", "signals.csv", *corrections, *sampled))
        write_samples(folder, run.fit, extra.intervals, made, str(run.config.path))
        png = run.config.config.report.png
        if page:
            write_page(folder, analysis, title, vehicle.constants, made, png=png)
        run.fit.timing["report"] = time.perf_counter() - started
        # fit.json comes last, since it holds the times of all other steps.
        run.fit.timing["total"] = time.perf_counter() - run.began
        content = files.fit_json(run.fit, run.problem, run.baseline, extra)
        files.write_json(folder / "fit.json", content)
    return replace(run, directory=out, supplementary=extra)


def _with_responses(run: FitRun) -> SupplementaryAnalyses:
    """Return the supplementary analyses with frequency responses, which only a report needs."""
    if run.supplementary.responses is not None:
        return run.supplementary
    from heli_jax.report.fitted_responses import fitted_responses

    options = run.config.config.frequency or FrequencyConfig()
    points = options.points or Settings().points
    settings = Settings(options.band, options.window, points)
    logged = {n for f in run.problem.training for n in f.outputs}
    requested = requested_handling(run.config, logged)
    responses = fitted_responses(run.fit, run.problem, settings, requested)
    gaps = missing_handling(run.config, logged)
    responses = responses._replace(notes=(*responses.notes, *gaps))
    return run.supplementary._replace(responses=responses)
