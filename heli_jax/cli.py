"""heli-jax: the command line."""

import argparse
import contextlib
import os
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from heli_jax import (
    cli_options,
    file_commands,
    import_path,
    interrupts,
    run_commands,
    run_directory,
    terminal,
)
from heli_jax.errors import InputError
from heli_jax.interrupts import resumable
from heli_jax.stages import Note

if TYPE_CHECKING:
    pass

# 2 is what argparse ends with.
DONE, WRONG_INPUT, NOT_DETERMINED, NOT_CONVERGED = 0, 2, 3, 4
INTERRUPTED = interrupts.INTERRUPTED


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # One line as all other errors; argparse would print the usage of the command before it.
        _refuse(self.prog, message)


def _refuse(prog: str, message: str) -> NoReturn:
    """End with one line, which names the help of the command (`heli-jax fit`) that was begun."""
    helps = "says what it takes" if " " in prog else "lists the commands"
    terminal.say(f"{message} ({prog} --help {helps})")
    raise SystemExit(WRONG_INPUT)


class _Version(argparse.Action):
    # Any: what argparse passes.
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from heli_jax.versions import version

        print(version())
        raise SystemExit(DONE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code.

    0 done; 2 wrong input; 3 the data cannot determine what was asked; 4 the optimiser did not
    converge, or the model is not adequate and explains less than the mean of what was measured;
    130 interrupted.
    """
    # With arguments of their own tests and programs call it, which an interrupt must not end.
    if arguments is None:
        import_path.pass_over_style_of_folder()
        # Of numbers that a log or a configuration holds: the sentence says what is wrong.
        warnings.filterwarnings(
            "ignore", category=RuntimeWarning, module=r"(heli_jax|numpy|scipy)\b"
        )
    with interrupts.as_program() if arguments is None else interrupts.as_function() as seen:
        for text in sys.argv[1:] if arguments is None else arguments:
            if any("\ud800" <= c <= "\udfff" for c in text):
                _refuse("heli-jax", f"expected arguments and names of files in UTF-8, got {text!r}")
        options, unknown = _parser().parse_known_args(arguments)
        if unknown:
            # Of which command, argparse has forgotten by then.
            message = f"unrecognized arguments: {' '.join(unknown)}"
            _refuse(f"heli-jax {options.command}", message)
        options.interrupts = seen
        try:
            options.say = terminal.say_notes if options.quiet else terminal.say
            with terminal.progress_shown(options.quiet):
                code = options.run(options)
            # Now, where a full disk is told in words.
            if sys.stdout is not None:
                sys.stdout.flush()
            return code
        except KeyboardInterrupt:
            terminal.say(seen.words())
            return 128 + seen.seen[0] if seen.seen else INTERRUPTED
        except BrokenPipeError:
            # `heli-jax simulate ... | head` is no failure. Python would flush its standard output
            # once more at the end, and complain.
            _discard_output()
            return DONE
        except Exception as e:
            # Whatever it says: an interrupt of which a library has made an error of its own.
            if seen.seen:
                terminal.say("interrupted")
                return INTERRUPTED
            # Everything else is a fault of ours, and its traceback is what a report of it needs.
            if not isinstance(e, InputError | OSError):
                raise
            if isinstance(e, OSError):
                # What was to be printed is still there, and would be tried again at the end.
                with contextlib.suppress(OSError, AttributeError, ValueError):
                    _discard_output()
                e = InputError(f"{e.filename or 'standard output'}: {e.strerror or e}")
            terminal.say(" ".join(str(e).split()))
            return WRONG_INPUT


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="heli-jax",
        description="Physical parameters of small helicopters from logged runs, with honest "
        "uncertainties.",
        epilog=cli_options.EXIT_CODES,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    # Each command's function becomes `options.run`, so that `main` needs no table of them.
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(
        name: str, run: Callable[[argparse.Namespace], int], words: str
    ) -> argparse.ArgumentParser:
        added = commands.add_parser(
            name, help=words, description=words, epilog=cli_options.EXIT_CODES
        )
        added.add_argument("--quiet", action="store_true", help="results, doubts and errors alone")
        added.set_defaults(run=run)
        return added

    fit = command("fit", _fit, "estimate parameters; write a run directory with a report")
    _add_config(fit)
    cli_options.add_fit_options(fit)
    fit.add_argument("--json", action="store_true", help="print fit.json, for other programs")
    agree = command("compatibility", _compatibility, "do a log's sensors agree? their errors")
    _add_config(agree)
    agree.add_argument("--out", metavar="DIR", help="run directory (default: as of fit)")
    check = command("check", _check, "identifiability, sampling and excitation before any fit")
    _add_config(check)
    check.add_argument("--json", action="store_true", help="everything, for other programs")
    windows = command("windows", _windows, "which parts of a log say most, before any fit")
    cli_options.add_windows_options(windows)
    _add_config(windows)
    frf = command("frf", _frf, "frequency responses of a log, with coherence and intervals")
    cli_options.add_frf_options(frf)
    _add_config(frf)
    simulate = command("simulate", _simulate, "simulate the configuration's run, or its flights")
    _add_config(simulate)
    cli_options.add_simulate_options(simulate)
    sweep = command("sweep", _sweep, "run a design of many vehicles; results in a Zarr store")
    _add_config(sweep)
    cli_options.add_sweep_options(sweep)
    info = command("info", _info, "signals, rates, duration and gaps of a log")
    cli_options.add_info_options(info)
    convert = command("convert", _convert, "signals of a log on one clock, as a table")
    cli_options.add_convert_options(convert)
    listing = command("runs", run_commands.runs, "the fits that a folder holds")
    cli_options.add_runs_options(listing)
    compare = command("compare", _compare, "fits side by side: estimates, verdicts, agreement")
    cli_options.add_compare_options(compare)
    new = command("new", _new, "a configuration that begins with what a log holds")
    cli_options.add_new_options(new)
    listing = command("keys", _keys, "what may stand in a configuration")
    cli_options.add_keys_options(listing)
    new_model = command("new-model", _new_model, "write the files that a model of one's own needs")
    new_model.add_argument("name", metavar="NAME", help="of the model and its module")
    new_model.add_argument("--out", metavar="DIR", help="new folder (default: NAME)")
    return parser


def _add_config(command: argparse.ArgumentParser) -> None:
    command.add_argument("config", metavar="CONFIG", help="experiment configuration (YAML)")
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="replace a value of the configuration: fit.free.a.start=5 or flights.0.rate=50",
    )


def _prepare_jax(cpu_devices: int | None = None) -> None:
    """float64, and a compilation cache that takes everything. Only entry points do this.

    Args:
        cpu_devices: so many processors are devices; JAX decides unless given.

    Raises:
        InputError: JAX_PLATFORMS asks for a device that is not there.
    """
    # Imports of JAX and of what uses it stand within the commands: they take seconds, and a wrong
    # option, --help and `info` need none of them.
    import jax

    jax.config.update("jax_enable_x64", True)
    # Where in the source each operation was traced: that is for who looks into what JAX compiles,
    # and takes a twentieth of `check`.
    jax.config.update("jax_include_full_tracebacks_in_locations", False)
    jax.config.update("jax_traceback_in_locations_limit", 0)
    # JAX keeps only programs that took a second to compile. A fit has dozens of small ones, which
    # add up to seconds.
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", _private_cache())
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if cpu_devices is not None:
        # Once JAX is in use their number stays as it is.
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", cpu_devices)
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms in ("", "cpu"):
        return
    try:
        jax.devices()
    # An assertion, where the part of JAX that knows the device is there and the device is not.
    except (RuntimeError, AssertionError) as e:
        raise InputError(
            f"JAX_PLATFORMS={platforms}: JAX finds no such device here, expected one that there is "
            "(a GPU of NVIDIA's needs its driver and the extra gpu: pip install 'heli_jax[gpu]'), "
            "or JAX_PLATFORMS=cpu"
        ) from e


def _cache() -> Path:
    """Where what was compiled and measured is kept from one command to the next."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "heli_jax"


def _private_cache() -> str | None:
    """The cache folder, of this user alone; None where it is not: what was compiled is code."""
    folder = _cache()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)  # refused where it is another user's, unless this one is root
        owner = folder.stat().st_uid
    except OSError:
        return None
    return str(folder) if getattr(os, "getuid", lambda: owner)() == owner else None


def _new_directory(options: argparse.Namespace) -> Path:
    """Where a run's files go, known to be free."""
    config = Path(options.config)
    out = Path(options.out) if options.out else run_directory.default_directory(config)
    resume = ", or --resume" if getattr(options, "over", None) else ""
    run_directory.require_free(out, resume)  # at once, before the seconds of the imports
    return out


def _fit(options: argparse.Namespace) -> int:
    began = time.perf_counter()  # before JAX is imported, which the user waits for too
    if not options.resume:
        _new_directory(options)
    _prepare_jax()
    from heli_jax import study_command

    study = study_command.asked(options)
    if study is not None:
        if options.json:
            raise InputError("--json: prints the fit.json of one fit, and a study has many")
        return study_command.fit(options, study, options.say)
    out = _new_directory(options)
    from heli_jax import output, workflow

    experiment = workflow.load_config(options.config, options.set)
    failure = None
    try:
        run = workflow.run_fit(experiment, out, progress=options.say, began=began)
    except workflow.NotWritten as e:
        # A fit of hours is shown at least.
        run, failure = e.run, e
    if options.json and run.directory is not None:
        print((run.directory / "fit.json").read_text(encoding="utf-8"), end="")
    else:
        output.print_fit(run)
    if failure is not None:
        raise failure
    return run.fit.exit_code


def _discard_output() -> None:
    """Send what is still to be printed nowhere."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _status_code(status: str) -> int:
    return {"converged": DONE, "not-identifiable": NOT_DETERMINED}.get(status, NOT_CONVERGED)


def _check(options: argparse.Namespace) -> int:
    _prepare_jax()
    from heli_jax import output, workflow
    from heli_jax.report import files

    config = workflow.load_config(options.config, options.set)
    check = workflow.run_check(config, progress=options.say)
    if options.json:
        print(files.as_json(files.check_json(check)))
    else:
        output.print_check(check)
    hopeless = any(f.severity == "refuse" for f in check.findings)
    return DONE if check.verdict.identifiable and not hopeless else NOT_DETERMINED


def _windows(options: argparse.Namespace) -> int:
    _prepare_jax()
    from heli_jax import log_windows, workflow

    experiment = workflow.load_config(options.config, options.set)
    ranking = log_windows.rank_log(experiment, options.log, options.length, progress=options.say)
    log_windows.print_ranking(ranking)
    if log_windows.cannot_be_fitted(ranking) or log_windows.not_determined(ranking):
        return NOT_DETERMINED
    return DONE


def _compatibility(options: argparse.Namespace) -> int:
    out = _new_directory(options)
    _prepare_jax()
    from heli_jax import output

    compatible = output.run_compatibility(options.config, out, options.set, options.say)
    return DONE if compatible else NOT_CONVERGED


def _frf(options: argparse.Namespace) -> int:
    out = _new_directory(options)
    _prepare_jax()
    from heli_jax import log_responses, workflow

    experiment = workflow.load_config(options.config, options.set)
    statuses = log_responses.run_responses(experiment, out, options.log, options.say)
    # The responses are written whatever comes of a transfer function; a script that looks at the
    # code alone must not take numbers that are not there.
    return max(map(_status_code, statuses), default=DONE)


def _simulate(options: argparse.Namespace) -> int:
    out = Path(options.out) if options.out else None
    if out is not None and out.suffix.lower() not in (".csv", ".parquet"):
        raise InputError(f"--out {out}: expected a name ending in .csv or .parquet")
    view = None
    if options.view is not None:
        beside = (out or Path(Path(options.config).name)).with_suffix(".html")
        view = Path(options.view) if options.view else beside
        if view.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--view {view}: expected a name ending in .html")
    # Both places before the simulation: what cannot be written is known now.
    for option, place in (("--out", out), ("--view", view)):
        if place is not None:
            run_directory.require_place(place, f"{option} {place}")
    _prepare_jax()
    from heli_jax import config as configuration
    from heli_jax import generate, simulation_output

    experiment = configuration.load(options.config, options.set)
    if experiment.config.simulate is not None:
        simulated = generate.generate(experiment)
    else:
        simulated = generate.follow(experiment)
    for found in simulated.notes:
        options.say(Note(found.of(options.config).sentence))
    simulation_output.write_table(out, simulated.columns)
    if out is not None:
        options.say(f"wrote {len(next(iter(simulated.columns.values())))} samples to {out}")
    if view is not None:
        simulation_output.write_view(view, experiment, simulated, out)
        whole = "" if simulated.whole else ", figures only: 3D needs the whole helicopter"
        options.say(f"wrote {view}{whole}")
    return DONE


def _sweep(options: argparse.Namespace) -> int:
    config = Path(options.config)
    if options.resume and not options.out:
        raise InputError("--resume: expected --out DIR too, the directory of the sweep")
    out = Path(options.out) if options.out else run_directory.default_directory(config)
    if not options.resume:
        run_directory.require_free(out, ", or --resume")
    from heli_jax.numerics.cores import cores

    # Each core a device of its own; where there are GPUs they are the devices.
    _prepare_jax(options.devices or cores())
    import jax

    from heli_jax import config as configuration
    from heli_jax import simulation_output, sweep_workflow
    from heli_jax.sweeps.store import FINISHED

    experiment = configuration.load(config, options.set)

    options.interrupts.words = lambda: resumable(out, FINISHED)
    # Processes of a cluster have to be told.
    options.interrupts.unwinds = bool(options.workers or options.scheduler)
    with (
        simulation_output.sweep_progress(quiet=options.quiet) as progress,
        cli_options.dask_client(options) as client,
    ):
        sweep_workflow.run_sweep(
            experiment,
            out,
            figures=not options.no_figures,
            resume=options.resume,
            # Of GPUs there are as many as there are, so --devices takes the first of them.
            devices=jax.local_devices()[: options.devices],
            client=client,
            memory=_cache() / "lanes.json",
            progress=progress,
            say=options.say,
        )
    simulation_output.print_sweep(out)
    return DONE


def _info(options: argparse.Namespace) -> int:
    from heli_jax import log_output
    from heli_jax.flights.describe import describe_flights

    clock = (options.time, options.time_unit, options.flight, options.time_rate)
    flights = list(describe_flights(options.log, *clock))
    if options.json:
        print(log_output.as_json(flights))
    else:
        log_output.print_flights(flights, options.channels, options.flight is not None)
    return DONE


def _convert(options: argparse.Namespace) -> int:
    from heli_jax.flights import convert

    out = Path(options.out)
    convert.require_output(out, options.log)
    run_directory.require_place(out, f"{out}")
    selection = cli_options.selection(options)
    if options.config is not None:
        _prepare_jax()
        from heli_jax import workflow
        from heli_jax.config.logs import as_configured

        selection = as_configured(workflow.load_config(options.config), selection)
    converted = convert.convert_log(options.log, selection)
    with run_directory.whole_file(out, f"{out}") as temporary:
        convert.write_converted(temporary, converted)
    for found in converted.notes:
        options.say(Note(found.of(options.log).sentence))
    columns = converted.columns
    count = len(columns) - 1
    of = "1 signal" if count == 1 else f"{count} signals"
    options.say(f"wrote {columns[convert.TIME].size} samples of {of} to {out}")
    return DONE


def _compare(options: argparse.Namespace) -> int:
    return run_commands.compare(options, options.say)


def _new(options: argparse.Namespace) -> int:
    return file_commands.new(options, options.say)


def _keys(options: argparse.Namespace) -> int:
    return file_commands.keys(options, options.say)


def _new_model(options: argparse.Namespace) -> int:
    return file_commands.new_model(options, options.say)


if __name__ == "__main__":
    raise SystemExit(main())
