"""A whole analysis as functions, for a script, a notebook and the command line alike.

`load_config` reads a configuration; `run_fit` does what `heli-jax fit` does, `run_check` what
`heli-jax check` does. `load_fit` reads what an earlier fit wrote.
"""

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from heli_jax import config as configuration
from heli_jax import run_directory
from heli_jax.analysis.flight_responses import Settings
from heli_jax.config import Experiment
from heli_jax.config.frequency import asked_handling, missing_handling
from heli_jax.config.frequency_section import FrequencyConfig
from heli_jax.errors import InputError, located, require_kind
from heli_jax.finding import Finding, note, once
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

# Words for people as the work goes on. A function and not a logger, which a notebook would have to
# set up and the command line to capture.
type Say = Callable[[str], None]


# A function of its own, so that the default of `progress` has a name in help().
def _silent(_: str) -> None:
    pass


@dataclass(frozen=True, eq=False)
class FitRun:
    """A fit with all that its configuration asks for beside it."""

    config: Experiment
    problem: Problem
    fit: Fit
    baseline: Baseline | None = None
    """the recursive least squares on the same data; None where it is off or has none to give"""
    supplementary: SupplementaryAnalyses = field(default_factory=SupplementaryAnalyses)
    """model selection and further intervals, where the configuration asks for them"""
    directory: Path | None = None
    """where the report is, once it is written"""
    began: float = field(default_factory=time.perf_counter)
    """when the work began, by `time.perf_counter` [s]"""

    # Drawn anew each time: a figure that is kept could be changed by who got it before. Any, since
    # matplotlib's classes are named in `report` alone.
    def figure(self, name: str) -> Any:
        """A figure of the report, drawn anew, as a matplotlib Figure: `response_OUTPUT`,
        `match_OUTPUT-INPUT`, `rls`, ...

        Raises:
            ValueError: the report has no figure of that name; the sentence lists those it has.
        """
        # Here, since matplotlib takes a second, and a fit without report needs none of it.
        from heli_jax.report.fit_page import Analysis, drawings
        from heli_jax.report.style import styled

        shown = _with_responses(self) if name.startswith(("match", "held")) else self.supplementary
        draw = drawings(Analysis(self.fit, self.problem, self.baseline, shown))
        figure = styled(draw[name]) if name in draw else None
        if figure is None:
            raise ValueError(f"figure: expected one of {', '.join(draw)}, got {name!r}")
        return figure

    def __repr__(self) -> str:
        where = "" if self.directory is None else f"\n  report: {self.directory / 'report.html'}"
        return f"FitRun of {self.config.path}: {self.fit!r}{where}"

    def _repr_html_(self) -> str:
        return self.fit._repr_html_()


def load_config(path: str | Path, overrides: Sequence[str] | Mapping[str, Any] = ()) -> Experiment:
    """Read and validate a configuration, its model and its vehicle; no log is opened yet.

    Args:
        path: the configuration (YAML); paths in it begin at its folder.
        overrides: values in place of the file's: `{"fit.free.a.start": 5}`, or as on the command
            line, `["fit.free.a.start=5"]`.

    Raises:
        InputError: anything in the file or an override is wrong.
    """
    return configuration.load(path, overrides)


def run_fit(
    config: Experiment | str | Path,
    out: str | Path | None = None,
    *,
    progress: Say = _silent,
    began: float | None = None,
) -> FitRun:
    """Fit a configuration's flights, with baseline, intervals and model selection as it asks.

    Args:
        config: of `load_config`, or the path of a configuration.
        out: directory for the report, as of `write_report`; none is written unless given.
        progress: called with what the log's reader assumed and what is going on, in words.
        began: when the work began, by `time.perf_counter` [s]; now unless given.

    Raises:
        InputError: a log or something of the configuration is wrong, a log is too slow for the
            model at its start values (docs/enough.md), or `out` cannot be written.
    """
    began = time.perf_counter() if began is None else began
    if out is not None:
        out = run_directory.free_directory(Path(out))  # before the work, not after it
    with recorded() as seconds:
        seconds["loading"] = time.perf_counter() - began
        run = _fit_run(config, progress, began, out)
        run.fit.timing.update(seconds)
    if out is None:
        return run
    progress("writing the report")
    with stage("writing the report"):
        return _written(run, Path(out), progress)


class NotWritten(InputError):
    """A fit is done and its run directory cannot be written; `run` has the fit."""

    run: FitRun


def _written(run: FitRun, out: Path, progress: Say) -> FitRun:
    """The run with its directory: that of a moment before, or a new one."""
    before = run.directory
    try:
        written = _write(run, before or out, replaces=before is not None)
    except InputError as e:
        failure = NotWritten(f"{e}; the fit stands above, in {before}" if before else str(e))
        failure.run = run
        raise failure from e
    if written.directory not in (out, before):
        words = f"{out}: another process created it; written to {written.directory}"
        progress(Note(words))
    return written


def _fit_run(
    config: Experiment | str | Path, progress: Say, began: float, out: str | Path | None
) -> FitRun:
    """`run_fit` without its report; before intervals that take long, that of the fit alone."""
    with stage("reading the log", name="reading"):
        config = config if isinstance(config, Experiment) else load_config(config)
        # One fit of it alone would look like the study's result.
        if config.config.study is not None:
            raise InputError(
                f"{config.path}: study: asks for many fits, expected heli_jax.run_study, or "
                "study: null"
            )
        problem = configuration.problem(config)
    # Before the fit, so that a unit or a hold taken wrongly is seen while the fit runs.
    for said in reading_notes(problem):
        progress(Note(said.sentence))
    options = config.config.fit
    assert options is not None  # `problem` refuses a configuration without
    # `fit` knows no file, and its sentence needs one
    with located(f"{config.path}: fit"):
        # Refused as by `check`: its estimates would look like any others.
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
    kept = None
    asked = options.intervals
    if out is not None and (asked.profile or asked.bootstrap or asked.nuts):
        kept = _keep(FitRun(config, problem, fitted, rls, began=began), Path(out), progress)
    try:
        further = _supplementary(config, problem, fitted, progress)
    except InputError:
        if kept is not None:
            shutil.rmtree(kept, ignore_errors=True)
        raise
    return FitRun(config, problem, fitted, rls, further, directory=kept, began=began)


def _keep(run: FitRun, out: Path, progress: Say) -> Path | None:
    """Write a fit before further intervals are sought, so that an interrupt does not lose it;
    returns its directory."""
    words = (
        "The run was interrupted: the requested profile, bootstrap or NUTS intervals are missing."
    )
    # Its own times: the run's go on.
    findings = (*run.fit.findings, note("uncertainty.interrupted", words))
    fitted = replace(run.fit, findings=findings, timing=dict(run.fit.timing))
    with stage("writing the fit", name="report before further intervals"):
        directory = _written(replace(run, fit=fitted), out, progress).directory
    progress(f"the fit is in {directory}; further intervals will be added to it")
    return directory


def run_check(config: Experiment | str | Path, *, progress: Say = _silent) -> Check:
    """Judge what a configuration's flights can determine, before any fit.

    Args:
        config: of `load_config`, or the path of a configuration.
        progress: called with what the log's reader assumed, in words.

    Raises:
        InputError: a log or something of the configuration is wrong.
    """
    config = config if isinstance(config, Experiment) else load_config(config)
    problem = configuration.problem(config)
    notes = reading_notes(problem)
    for said in notes:
        progress(Note(said.sentence))
    with located(f"{config.path}: fit"), stage("what the log can determine"):
        return replace(check(problem), log_notes=tuple(notes))


def reading_notes(problem: Problem) -> list[Finding]:
    """Notes of the logs' readers, and on the origin of starts that were found."""
    guess = problem.first_guess
    return once((*log_notes(problem), *(guess.findings if guess else ())))


def log_notes(problem: Problem) -> list[Finding]:
    """Notes of the logs' readers; each sentence begins with its log."""
    notes = []
    for flight in problem.flights:
        where = flight.source.path if flight.source else flight.name
        notes += [n.of(where) for n in (flight.source.notes if flight.source else ())]
        notes += [
            note(
                "hold.guessed",
                f"{where}: {name} is taken as {flight.hold[name]} between samples, since it "
                f"{reason}",
                name,
            )
            for name, reason in flight.hold_reason.items()
            # Held inputs are what a reader expects of a stick, and need no word.
            if flight.hold[name] != "zero-order"
        ]
    # Several flights may be windows of one log: what is the same for all of them is said once.
    return once(notes)


def _baseline(config: Experiment, problem: Problem, fitted: Fit, progress: Say) -> Baseline | None:
    options = config.config.rls
    if options is None:
        return None
    progress("recursive least squares")
    # A baseline that fails must not cost the fit: too short a record, or a model that has none.
    estimate = None
    try:
        estimate = baseline(
            config.model,
            config.vehicle.params,
            problem.training[0],  # RLS takes one record; the paper has no other
            order=options.order,
            forgetting=options.forgetting,
        )
    except ValueError as e:
        progress(Note(f"no baseline: {e}"))
    return estimate


def _supplementary(
    config: Experiment, problem: Problem, fitted: Fit, progress: Say
) -> SupplementaryAnalyses:
    """Further intervals and model selection, where the configuration asks for them."""
    options = config.config.fit
    assert options is not None
    asked, further, choice, methods = options.intervals, None, None, None
    if asked.profile or asked.bootstrap or asked.nuts:
        with located(f"{config.path}: fit"):
            further = intervals(
                fitted,
                profiles=asked.profile,
                runs=asked.bootstrap,
                draws=asked.nuts,
                seed=options.seed,
                progress=progress,
            )
    # Each its own stage, as profiles, bootstrap and NUTS are: any of them may be what takes long.
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
    """Fit the models that `fit.compare` puts beside a configuration's own, and compare them by
    likelihood ratio, AIC and BIC.

    Args:
        config: of `load_config`, or the path of a configuration.
        problem: the configuration's problem where it is at hand (`FitRun.problem`), so that the
            logs need not be read again.
        progress: called with what is going on, in words.

    Raises:
        InputError: no axis of the model can be disturbed, or a model cannot be fitted.
    """
    config = config if isinstance(config, Experiment) else load_config(config)
    # All share the fitted problem's flights: likelihoods of different data do not compare.
    candidates = configuration.candidate_models(config, problem or configuration.problem(config))
    with located(f"{config.path}: fit"):
        return choose(candidates.problems, candidates.nested, progress=progress)


def write_report(run: FitRun, out: str | Path) -> FitRun:
    """Write a fit's run directory: config.yaml, fit.json, signals.csv, report.html, figures/; and
    posterior.nc and bootstrap.nc where there are draws of NUTS and samples of the bootstrap.

    The directory appears whole or not at all. Returns the run with `directory` set: `out`, or where
    that exists a numbered sibling, with a warning.

    Args:
        run: of `run_fit`.
        out: the directory.

    Raises:
        InputError: `out` cannot be written to, or the extra `bayes` is missing.
        TypeError: `run` is no FitRun.
    """
    require_kind("run", run, FitRun, "a FitRun, as heli_jax.run_fit(config) returns it")
    return _write(run, run_directory.free_directory(Path(out)))


def _write(run: FitRun, out: Path, *, replaces: bool = False) -> FitRun:
    """The run directory, in place of that of an earlier moment of this run where it `replaces`
    one."""
    from heli_jax.report.fit_page import Analysis
    from heli_jax.report.fit_page import write_report as write_page
    from heli_jax.report.origin import origin
    from heli_jax.report.sample_files import sample_files, write_samples

    started = time.perf_counter()
    # Before the figures: a configuration that cannot be written out fails at once.
    text = as_yaml(configuration.resolved(run.config))
    vehicle, extra = run.config.vehicle, _with_responses(run)
    with run_directory.whole(out, replaces=replaces, or_beside=not replaces) as folder:
        (folder / "config.yaml").write_text(text, encoding="utf-8")
        files.write_signals(folder / "signals.csv", run.fit.signals)
        title = run.config.path.stem
        analysis = Analysis(run.fit, run.problem, run.baseline, extra)
        sampled = sample_files(extra.intervals)
        corrections = ("compatibility.yaml",) if extra.sensors else ()
        made = origin(text, ("config.yaml", "fit.json", "signals.csv", *corrections, *sampled))
        write_samples(folder, run.fit, extra.intervals, made, str(run.config.path))
        png = run.config.config.report.png
        write_page(folder, analysis, title, vehicle.constants, made, png=png)
        run.fit.timing["report"] = time.perf_counter() - started
        # fit.json comes last, since it holds how long all the rest took.
        run.fit.timing["total"] = time.perf_counter() - run.began
        content = files.fit_json(run.fit, run.problem, run.baseline, extra)
        files.write_json(folder / "fit.json", content)
    return replace(run, directory=run_directory.written()[-1], supplementary=extra)


def _with_responses(run: FitRun) -> SupplementaryAnalyses:
    """The supplementary analyses with those of the frequency domain, which only a report shows."""
    if run.supplementary.responses is not None:
        return run.supplementary
    from heli_jax.report.fitted_responses import fitted_responses

    options = run.config.config.frequency or FrequencyConfig()
    points = options.points or Settings().points
    settings = Settings(options.band, options.window, points)
    logged = {n for f in run.problem.training for n in f.outputs}
    asked = asked_handling(run.config, logged)
    responses = fitted_responses(run.fit, run.problem, settings, asked)
    gaps = missing_handling(run.config, logged)
    responses = responses._replace(notes=(*responses.notes, *gaps))
    return run.supplementary._replace(responses=responses)
