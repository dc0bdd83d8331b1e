"""heli-jax: the command line."""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from heli_jax.errors import InputError

DONE, WRONG_INPUT, NOT_DETERMINED, NOT_CONVERGED, INTERRUPTED = 0, 2, 3, 4, 130


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        print(f"heli-jax: {message} (heli-jax --help lists the commands)", file=sys.stderr)
        raise SystemExit(WRONG_INPUT)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code.

    0 done; 2 wrong input; 3 the data cannot determine what was asked; 4 the optimiser did not
    converge; 130 interrupted.
    """
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except InputError as e:
        _say(" ".join(str(e).split()))
        return WRONG_INPUT
    except KeyboardInterrupt:
        _say("interrupted; nothing was written")
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="heli-jax",
        description="Physical parameters of small helicopters from logged runs, with honest "
        "uncertainties.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Any, words: str) -> argparse.ArgumentParser:
        one = commands.add_parser(name, help=words, description=words)
        one.set_defaults(run=run)
        return one

    def with_config(one: argparse.ArgumentParser) -> None:
        one.add_argument("config", metavar="CONFIG", help="experiment configuration (YAML)")
        one.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            help="replace a value of the configuration: fit.free.a.start=5 or flights.0.rate=50",
        )

    fit = command("fit", _fit, "estimate parameters; write a run directory with a report")
    with_config(fit)
    fit.add_argument("--out", metavar="DIR", help="run directory (default: runs/NAME-DATE-TIME)")
    check = command("check", _check, "identifiability, sampling and excitation before any fit")
    with_config(check)
    simulate = command("simulate", _simulate, "simulate the configuration's run, or its flights")
    with_config(simulate)
    simulate.add_argument("--out", metavar="FILE", help=".csv or .parquet (default: CSV on stdout)")
    simulate.add_argument(
        "--view",
        nargs="?",
        const="",
        metavar="HTML",
        help="also a page with figures and the flight in 3D (default: beside --out)",
    )
    info = command("info", _info, "signals, rates, duration and gaps of a log")
    info.add_argument("log", metavar="LOG", help=".csv, .txt, .tsv or .parquet")
    info.add_argument("--time", metavar="NAME", help="the column of time stamps")
    return parser


def _say(text: str) -> None:
    print(f"heli-jax: {text}", file=sys.stderr, flush=True)


def _prepare_jax() -> None:
    """float64, and a compilation cache that takes everything. Only entry points do this."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(base) / "heli_jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _fit(options: argparse.Namespace) -> int:
    from heli_jax import run_directory

    begin = time.perf_counter()
    config = Path(options.config)
    out = Path(options.out) if options.out else run_directory.default_directory(config)
    run_directory.require_free(out)
    _prepare_jax()
    from heli_jax import config as configuration
    from heli_jax.identification.baseline import baseline
    from heli_jax.identification.fit import fit

    experiment = configuration.load(config, options.set)
    problem = configuration.problem(experiment)
    wanted = experiment.config.fit
    assert wanted is not None
    _warn_reading(problem)
    try:
        found = fit(
            problem,
            starts=wanted.starts,
            seed=wanted.seed,
            max_steps=wanted.max_steps,
            progress=_say,
        )
    except ValueError as e:
        raise InputError(f"{config}: fit: {e}") from e
    rls = None
    if experiment.config.rls is not None:
        _say("recursive least squares")
        started = time.perf_counter()
        try:
            rls = baseline(
                experiment.model,
                experiment.vehicle.params,
                problem.training[0],
                order=experiment.config.rls.order,
                forgetting=experiment.config.rls.forgetting,
            )
        except ValueError as e:
            _say(f"no baseline: {e}")
        found.timing["rls"] = time.perf_counter() - started
    from heli_jax import output

    further = _further(experiment, problem, found)
    _say("writing the report")
    output.write_fit(out, experiment, problem, found, rls, further, begin)
    output.print_fit(problem, found, rls, further, out)
    return {"converged": DONE, "not-identifiable": NOT_DETERMINED}.get(found.status, NOT_CONVERGED)


def _further(experiment: Any, problem: Any, found: Any) -> Any:
    """Model choice and further intervals, where the configuration asks for them."""
    from heli_jax import config as configuration
    from heli_jax.identification.choice import choose
    from heli_jax.identification.intervals import intervals
    from heli_jax.report.files import Further

    wanted = experiment.config.fit
    more, choice = None, None
    asked = wanted.intervals
    try:
        if asked.profile or asked.bootstrap or asked.nuts:
            more = intervals(
                found,
                profiles=asked.profile,
                runs=asked.bootstrap,
                draws=asked.nuts,
                seed=wanted.seed,
                progress=_say,
            )
        if wanted.compare:
            rivals = configuration.rivals(experiment, problem)
            choice = choose(rivals.problems, rivals.nested, progress=_say)
    except ValueError as e:
        raise InputError(f"{experiment.path}: fit: {e}") from e
    return Further(choice, more)


def _warn_reading(problem: Any) -> None:
    for flight in problem.flights:
        for note in flight.source.notes if flight.source else ():
            _say(f"{flight.source.path}: {note}")


def _check(options: argparse.Namespace) -> int:
    _prepare_jax()
    from heli_jax import config as configuration
    from heli_jax import output
    from heli_jax.identification.fit import check

    experiment = configuration.load(options.config, options.set)
    problem = configuration.problem(experiment)
    _warn_reading(problem)
    try:
        found = check(problem)
    except ValueError as e:
        raise InputError(f"{options.config}: fit: {e}") from e
    output.print_check(found)
    return DONE if found.verdict.identifiable else NOT_DETERMINED


def _simulate(options: argparse.Namespace) -> int:
    out = Path(options.out) if options.out else None
    if out is not None and out.suffix.lower() not in (".csv", ".parquet"):
        raise InputError(f"--out {out}: wanted is a name ending in .csv or .parquet")
    view = None
    if options.view is not None:
        beside = (out or Path(Path(options.config).name)).with_suffix(".html")
        view = Path(options.view) if options.view else beside
        if view.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--view {view}: wanted is a name ending in .html")
    _prepare_jax()
    from heli_jax import config as configuration
    from heli_jax import generate, output

    experiment = configuration.load(options.config, options.set)
    if experiment.config.simulate is not None:
        simulated = generate.generate(experiment)
    else:
        simulated = generate.follow(experiment)
    for note in simulated.notes:
        _say(f"{options.config}: {note}")
    output.write_table(out, simulated.columns)
    if out is not None:
        _say(f"wrote {len(next(iter(simulated.columns.values())))} samples to {out}")
    if view is not None:
        output.write_view(view, experiment, simulated)
        whole = "" if simulated.whole else ", figures only: 3D needs the whole helicopter"
        _say(f"wrote {view}{whole}")
    return DONE


def _info(options: argparse.Namespace) -> int:
    from heli_jax import output
    from heli_jax.flights import describe_log

    output.print_info(describe_log(options.log, options.time))
    return DONE


if __name__ == "__main__":
    raise SystemExit(main())
