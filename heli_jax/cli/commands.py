"""heli-jax: the command line."""

import argparse
import contextlib
import json
import math
import os
import shlex
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from heli_jax import import_path, run_directory
from heli_jax.cli import terminal
from heli_jax.cli.jax_settings import prepare_jax
from heli_jax.cli.terminal import print_table, print_text
from heli_jax.errors import InputError, located
from heli_jax.stages import Note
from heli_jax.versions import version

if TYPE_CHECKING:
    from heli_jax.config.study import Study
    from heli_jax.flights.convert import Selection

# argparse itself exits with 2.
DONE, WRONG_INPUT, NOT_DETERMINED, NOT_CONVERGED, INTERRUPTED = 0, 2, 3, 4, 130
_EXIT_CODES = (
    "Exit codes: 0 done; 2 wrong input, in one sentence; 3 the data cannot determine what was "
    "asked, or an interval is not trusted; 4 an optimiser did not converge, the model is not "
    "adequate, or sensors are not compatible; 130 interrupted."
)


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"expected a number of seconds above 0, got {text!r}")
    return value


# Any: keywords of argparse.
def _arg(*names: str, **keywords: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return one argument of a command."""
    if names[0].startswith("--") and not keywords.keys() & {"action", "metavar"}:
        keywords["action"] = "store_true"
    return names, keywords


# fmt: off
_CONFIG = (
    _arg("config", metavar="CONFIG", help="experiment configuration (YAML)"),
    _arg("--set", action="append", default=[], metavar="KEY=VALUE",
         help="replace a value of the configuration: fit.free.a.start=5 or flights.0.rate=50"),
)
_OUT = _arg("--out", metavar="DIR", help="directory (default: runs/NAME-DATE-TIME)")
_JSON = _arg("--json", help="print everything as JSON, for other programs")
_VERBOSE = _arg("--verbose", help="all findings, agreement and gates (default: three findings)")
_LOG = _arg("log", metavar="LOG", help="a table or an autopilot's log: docs/logs.md")
_OTHER_LOG = _arg("log", nargs="?", metavar="LOG",
                  help="read like the first log of the configuration (default: that log)")
_CLOCK = (
    _arg("--time", metavar="NAME", help="column of time stamps of a table"),
    _arg("--time-unit", metavar="UNIT", help="unit of the stamps: s, ms, us or ns"),
)
_TIME_RATE = _arg("--time-rate", type=float, metavar="HZ",
                  help="samples per second of a table without times")
_FLIGHT = _arg("--flight", type=_count, metavar="N",
               help="number of the flight in a log of several (from 1)")
_RESUME = _arg("--resume", help="continue the study or sweep in --out")
_SCHEDULER = _arg("--scheduler", metavar="tcp://HOST:8786",
                  help="compute on the workers of this dask scheduler")
_COMMANDS = {
    "fit": ("estimate parameters; write a run directory with a report", (
        *_CONFIG, _OUT, _JSON, _VERBOSE, _RESUME, _SCHEDULER,
        _arg("--workers", type=_count, metavar="N",
             help="processes on this machine for a study (default: one a core)"),
        _arg("--over", action="append", default=[], metavar="KEY=VALUE,VALUE",
             help="a study (docs/studies.md): fit with each value, with several keys each "
             "combination; or study in CONFIG"),
        _arg("--reports", help="also write the page of each fit of a study"),
    )),
    "compatibility": ((
        "agreement of a log's sensors with each other, and their errors"
    ), (*_CONFIG, _OUT)),
    "check": ("identifiability, sampling and excitation before any fit", (
        *_CONFIG, _JSON, _VERBOSE,
    )),
    "windows": ("most informative windows of a log, before any fit", (
        _OTHER_LOG, *_CONFIG,
        _arg("--length", type=_seconds, metavar="S",
             help="length of a window [s] (default: a twelfth)"),
    )),
    "design": ("inputs that determine the parameters best, before any flight", (
        *_CONFIG, _OUT, _VERBOSE,
        _arg("--for", dest="wanted", action="append", default=[], metavar="NAME=PERCENT",
             help="sd of a parameter that is enough: a=2%% (default: design.wanted)"),
    )),
    "control": ("gains and margins of a controller over the posterior of a fit", (
        *_CONFIG, _OUT, _VERBOSE,
        _arg("--fit", metavar="DIR", help="run directory of a fit (default: control.fit)"),
    )),
    "frf": ("frequency responses of a log, with coherence and intervals", (
        _OTHER_LOG, *_CONFIG, _OUT,
    )),
    "stream": ("follow a flight while it goes on, then fit it", (
        *_CONFIG, _OUT, _VERBOSE,
        _arg("--from", dest="place", metavar="PLACE",
             help="a growing table, - for standard input, or mavlink:DEVICE (default: the first "
             "log of the configuration); Ctrl-C ends it"),
        _arg("--for", dest="wanted", action="append", default=[], metavar="NAME=SD",
             help="wanted sd of a parameter or quotient: Ixx=2%%, a/If=100"),
        _arg("--until-end", help="end with the present end of the file"),
        _arg("--block", type=_seconds, metavar="S",
             help="length of the blocks that are estimated [s] (default: 20)"),
    )),
    "simulate": ("simulate the configuration's run, or its flights", (
        *_CONFIG,
        _arg("--out", metavar="FILE", help=".csv or .parquet (default: CSV on stdout)"),
    )),
    "sweep": ("run a design of many vehicles; results in a Zarr store", (
        *_CONFIG, _OUT, _RESUME, _SCHEDULER,
        _arg("--devices", type=_count, metavar="N",
             help="processor cores or GPUs to use (default: all)"),
        _arg("--no-figures", help="draw no figures"),
    )),
    "info": ("signals, rates, duration and gaps of a log", (
        _LOG, *_CLOCK, _TIME_RATE, _FLIGHT, _JSON,
        _arg("--channels", metavar="PATTERN", help="list these: 'vehicle_attitude*'"),
    )),
    "convert": ("signals of a log on one clock, as a table", (
        _LOG, _arg("out", metavar="OUT", help=".csv or .parquet"),
        *_CLOCK, _TIME_RATE, _FLIGHT,
        _arg("--signals", nargs="+", default=[], metavar="NAME",
             help="'vehicle_attitude.*', 'euler(vehicle_attitude.q).roll' (default all)"),
        _arg("--preset", metavar="NAME", help=(
            "the configuration's signals, by its names and in SI"
        )),
        _arg("--rate", type=float, metavar="HZ", help="resample to this rate"),
        _arg("--window", nargs=2, type=float, metavar=("FROM", "TO"),
             help="[s] from the log's beginning"),
    )),
    "runs": ("list the fits of a folder", (
        _arg("directory", nargs="?", default="runs", metavar="DIR", help="default: runs"), _JSON,
    )),
    "compare": ("fits side by side: estimates, verdicts, agreement", (
        _arg("runs", nargs="+", metavar="RUN", help="directories of heli-jax fit"),
        _arg("--out", metavar="FILE", help="page (.html) or estimates (.csv)"),
    )),
    "new": ("write a configuration from a log, with guesses marked", (
        _LOG, _TIME_RATE, _FLIGHT,
        _arg("--model", metavar="NAME",
             help="as a configuration names it, such as roll-on-stand or attitude-flybarless "
             "(default: by the vehicle and the axis that moves most, see heli-jax models)"),
        _arg("--vehicle", metavar="FILE", help="an existing vehicle file"),
        _arg("--out", metavar="FILE", help="configuration (default: the log's name)"),
    )),
    "keys": ("keys of a configuration and their meaning", (
        _arg("pattern", nargs="?", metavar="TEXT",
             help="text in keys or their meaning (default: all keys)"),
        _JSON,
        _arg("--schema", metavar="FILE",
             help="write the JSON schema for editors"),
        _arg("--fit", help="keys of fit.json instead"),
    )),
    "models": ("list the models that ship, or describe one", (
        _arg("name", nargs="?", metavar="NAME",
             help="roll-on-stand, linear:roll or mine.yaml: states, parameters, sources, modes "
             "(default: all models, a line each)"),
        _JSON,
        _arg("--config", metavar="FILE",
             help="write a configuration for heli-jax design with this linear model"),
    )),
    "new-model": ("write the files of a model of your own", (
        _arg("name", metavar="NAME", help="name of the model and its module"),
        _arg("--out", metavar="DIR", help="new folder (default: NAME)"),
    )),
}
# fmt: on
"""Help and arguments of each command. The function of `new-model` is `_new_model`."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # Print one line, as for all other errors. argparse would print the usage before it.
        _refuse(self.prog, message)


def _refuse(prog: str, message: str) -> NoReturn:
    """Exit with one line that names the help of the command in use (`heli-jax fit`)."""
    terminal.say(f"{message} (see {prog} --help)")
    raise SystemExit(WRONG_INPUT)


class _Version(argparse.Action):
    # Any: what argparse passes.
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print(version())
        raise SystemExit(DONE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0 done; 2 wrong input; 3 the data cannot determine what was asked; 4 the optimiser did not
    converge, or the model is not adequate and explains less than the mean of the measurements; 130
    interrupted.
    """
    # Tests and other programs pass arguments.
    if arguments is None:
        import_path.ignore_folder_style()
        # These warnings concern numbers of a log or a configuration, which the message explains.
        warnings.filterwarnings(
            "ignore", category=RuntimeWarning, module=r"(heli_jax|numpy|scipy)\b"
        )
    for text in sys.argv[1:] if arguments is None else arguments:
        if any("\ud800" <= c <= "\udfff" for c in text):
            _refuse("heli-jax", f"expected arguments and names of files in UTF-8, got {text!r}")
    options, unknown = _parser().parse_known_args(arguments)
    if unknown:
        # argparse no longer knows the command here.
        message = f"unrecognized arguments: {' '.join(unknown)}"
        _refuse(f"heli-jax {options.command}", message)
    code = DONE
    try:
        options.say = terminal.say_notes if options.quiet else terminal.say
        with terminal.progress_shown(options.quiet):
            code = globals()[f"_{options.command.replace('-', '_')}"](options)
        # Flush here, so that a full disk ends in a message.
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        terminal.say("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # `heli-jax simulate ... | head` is no failure and keeps its exit code. Python would
        # flush standard output again at exit and complain.
        _discard_output()
        return code
    # Any other error is a bug, and its report needs the traceback.
    except (InputError, OSError) as e:
        if isinstance(e, OSError):
            # Unprinted output is still buffered and would be flushed again at exit.
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
        epilog=_EXIT_CODES,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command, (words, arguments) in _COMMANDS.items():
        added = commands.add_parser(command, help=words, description=words, epilog=_EXIT_CODES)
        added.add_argument(
            "--quiet", action="store_true", help="print results, doubts and errors only"
        )
        for names, keywords in arguments:
            added.add_argument(*names, **keywords)
    return parser


def _new_directory(options: argparse.Namespace) -> Path:
    """Return the directory for a run's files, which does not exist yet."""
    out = _directory(options)
    resume = ", or --resume" if hasattr(options, "resume") else ""
    run_directory.require_free(out, resume)  # check before the imports, which take seconds
    return out


def _directory(options: argparse.Namespace) -> Path:
    config = Path(options.config)
    return Path(options.out) if options.out else run_directory.default_directory(config)


def _fit(options: argparse.Namespace) -> int:
    began = time.perf_counter()  # before the import of JAX, whose seconds count
    if not options.resume:
        _new_directory(options)
    prepare_jax()
    from heli_jax.config.study import read_study

    study = read_study(options.config, options.set, options.over)
    if study is not None:
        return _fit_study(options, study)
    for option in ("resume", "workers", "scheduler", "reports"):
        if getattr(options, option):
            raise InputError(
                f"--{option}: is only for a study of fits, expected --over KEY=VALUE,VALUE, or "
                f"study in {options.config}"
            )
    out = _new_directory(options)
    from heli_jax import workflow
    from heli_jax.cli import fits

    experiment = workflow.load_config(options.config, options.set)
    run = workflow.run_fit(experiment, out, progress=options.say, began=began)
    if options.json:
        print((out / "fit.json").read_text(encoding="utf-8"), end="")
    else:
        fits.print_fit(run, verbose=options.verbose)
    return run.fit.exit_code


def _fit_study(options: argparse.Namespace, study: "Study") -> int:
    """Run a study, print it, and return the exit code of the worst fit."""
    from heli_jax.cli import simulations
    from heli_jax.studies import run as studies

    if options.json:
        raise InputError("--json: prints the fit.json of one fit, and a study has many")
    _require_out(options)
    out = _directory(options)
    with simulations.dask_client(options.scheduler) as client:
        how = {"workers": options.workers, "client": client, "reports": options.reports}
        result = studies.run(study, out, studies.Options(options.resume, **how, say=options.say))
    simulations.print_study(result)
    print_text(f"fits: {out / 'fits'}\nDataset: {out / studies.STORE}")
    return simulations.study_exit_code(result)


def _require_out(options: argparse.Namespace) -> None:
    if options.resume and not options.out:
        raise InputError("--resume: expected --out DIR too, the directory of the interrupted run")


def _discard_output() -> None:
    """Discard output that is not yet printed."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _check(options: argparse.Namespace) -> int:
    prepare_jax()
    from heli_jax import workflow
    from heli_jax.cli import fits
    from heli_jax.report import files

    config = workflow.load_config(options.config, options.set)
    check = workflow.run_check(config, progress=options.say)
    if options.json:
        print(files.as_json(files.check_json(check)))
    else:
        fits.print_check(check, verbose=options.verbose)
    hopeless = any(f.severity == "refuse" for f in check.findings)
    return DONE if check.verdict.identifiable and not hopeless else NOT_DETERMINED


def _windows(options: argparse.Namespace) -> int:
    prepare_jax()
    from heli_jax import workflow
    from heli_jax.cli import windows

    experiment = workflow.load_config(options.config, options.set)
    ranking = windows.rank_log(experiment, options.log, options.length, progress=options.say)
    windows.print_ranking(ranking)
    if windows.cannot_be_fitted(ranking) or windows.not_determined(ranking):
        return NOT_DETERMINED
    return DONE


def _design(options: argparse.Namespace) -> int:
    out = _new_directory(options)
    from heli_jax.cli import designs

    wanted = designs.wanted_sds(options.wanted)
    prepare_jax()
    from heli_jax import workflow
    from heli_jax.design_workflow import run_design

    experiment = workflow.load_config(options.config, options.set)
    run = run_design(experiment, out, wanted=wanted or None, progress=options.say)
    designs.print_design(run, verbose=options.verbose)
    if run.design.optimum.undetermined:
        return NOT_DETERMINED
    return DONE if run.design.converged else NOT_CONVERGED


def _control(options: argparse.Namespace) -> int:
    out = _new_directory(options)
    prepare_jax()
    from heli_jax import workflow
    from heli_jax.cli import controls
    from heli_jax.control_workflow import run_control

    experiment = workflow.load_config(options.config, options.set)
    run = run_control(experiment, out, fit=options.fit, progress=options.say)
    controls.print_control(run, verbose=options.verbose)
    return DONE if run.sound else NOT_CONVERGED


def _compatibility(options: argparse.Namespace) -> int:
    out = _new_directory(options)
    prepare_jax()
    from heli_jax import compatibility
    from heli_jax.cli import fits

    result = compatibility.run_compatibility(
        options.config, out, overrides=options.set, progress=options.say
    )
    fits.print_compatibility(result)
    return DONE if result.compatible else NOT_CONVERGED


def _frf(options: argparse.Namespace) -> int:
    out = _new_directory(options)
    prepare_jax()
    from heli_jax import workflow
    from heli_jax.cli import responses

    experiment = workflow.load_config(options.config, options.set)
    statuses = responses.run_responses(experiment, out, options.log, options.say)
    # Responses are written even if a transfer function fails. The exit code shows scripts that its
    # numbers are missing.
    codes = {"converged": DONE, "not-identifiable": NOT_DETERMINED}
    return max((codes.get(status, NOT_CONVERGED) for status in statuses), default=DONE)


def _stream(options: argparse.Namespace) -> int:
    out = _new_directory(options)
    log = out.with_name(f"{out.name}.csv")
    run_directory.require_free(log)
    run_directory.require_place(log, f"{log}")
    prepare_jax()
    from heli_jax import workflow
    from heli_jax.cli import fits, stream
    from heli_jax.cli.wanted import wanted_of

    experiment = workflow.load_config(options.config, options.set)
    wanted = wanted_of(options.wanted)
    with stream.ending_block() as stopped:
        experiment = stream.run_stream(
            experiment,
            options.place,
            wanted,
            log,
            until_end=options.until_end,
            block=options.block,
            stopped=stopped,
        )
    options.say(f"wrote what was received to {log}")
    run = workflow.run_fit(experiment, out, progress=options.say)
    fits.print_fit(run, verbose=options.verbose)
    return run.fit.exit_code


def _simulate(options: argparse.Namespace) -> int:
    out = Path(options.out) if options.out else None
    if out is not None and out.suffix.lower() not in (".csv", ".parquet"):
        raise InputError(f"--out {out}: expected a name ending in .csv or .parquet")
    # Check the place before the simulation.
    if out is not None:
        run_directory.require_place(out, f"--out {out}")
    prepare_jax()
    from heli_jax import config as configuration
    from heli_jax import generate
    from heli_jax.cli import simulations

    experiment = configuration.load(options.config, options.set)
    if experiment.config.simulate is not None:
        simulated = generate.generate(experiment)
    else:
        simulated = generate.follow(experiment)
    for found in simulated.notes:
        options.say(Note(found.of(options.config).sentence))
    simulations.write_table(out, simulated.columns)
    if out is not None:
        options.say(f"wrote {len(next(iter(simulated.columns.values())))} samples to {out}")
    return DONE


def _sweep(options: argparse.Namespace) -> int:
    _require_out(options)
    out = _directory(options) if options.resume else _new_directory(options)
    from heli_jax.numerics.cores import cores

    # Each core is a device, unless there are GPUs.
    prepare_jax(options.devices or cores())
    import jax

    from heli_jax import config as configuration
    from heli_jax import sweep_workflow
    from heli_jax.cli import simulations

    experiment = configuration.load(options.config, options.set)
    with simulations.dask_client(options.scheduler) as client:
        sweep_workflow.run_sweep(
            experiment,
            out,
            figures=not options.no_figures,
            resume=options.resume,
            # The number of GPUs is fixed, so --devices takes the first of them.
            devices=jax.local_devices()[: options.devices],
            client=client,
            say=options.say,
        )
    simulations.print_sweep(out)
    return DONE


def _info(options: argparse.Namespace) -> int:
    from heli_jax.cli import logs
    from heli_jax.flights.describe import describe_flights

    clock = (options.time, options.time_unit, options.flight, options.time_rate)
    flights = list(describe_flights(options.log, *clock))
    if options.json:
        print(logs.as_json(flights))
    else:
        logs.print_flights(flights, options.channels, options.flight is not None)
    return DONE


def _convert(options: argparse.Namespace) -> int:
    from heli_jax.flights import convert

    out = Path(options.out)
    convert.require_output(out, options.log)
    run_directory.require_place(out, f"{out}")
    selection = _selection(options)
    converted = convert.convert_log(options.log, selection)
    with run_directory.whole_file(out, f"{out}") as temporary:
        convert.write_converted(temporary, converted)
    for found in converted.notes:
        options.say(Note(found.of(options.log).sentence))
    columns = converted.columns
    size = columns[convert.TIME].size
    options.say(f"wrote {size} samples of {len(columns) - 1} signals to {out}")
    return DONE


def _selection(options: argparse.Namespace) -> "Selection":
    """Return the part of a log that `convert` writes."""
    from heli_jax.flights import convert
    from heli_jax.flights.preset import by_preset as named_by

    if options.preset is not None and options.signals:
        raise InputError("--preset: already names the columns, expected it without --signals")
    by_preset = None
    if options.preset is not None:
        with located("--preset"):
            by_preset = named_by(options.preset)
    return convert.Selection(
        options.signals,
        options.rate,
        None if options.window is None else tuple(options.window),
        options.flight,
        options.time,
        options.time_unit,
        options.time_rate,
        by_preset,
    )


def _runs(options: argparse.Namespace) -> int:
    from heli_jax.cli import runs

    listed = runs.listed(Path(options.directory))
    if options.json:
        print(json.dumps(listed, indent=1))
        return DONE
    if not listed:
        raise InputError(f"{options.directory}: holds no run of heli-jax fit")
    keys = ("run", "date", "model", "method", "status", "adequate", "untrusted")
    print_table(keys, [tuple(str(run[k]) for k in keys) for run in listed])
    return DONE


def _compare(options: argparse.Namespace) -> int:
    from heli_jax.cli import runs
    from heli_jax.report.compared_runs import compare_runs

    place = None if options.out is None else Path(options.out)
    endings = (".html", ".csv")
    if place is not None and place.suffix.lower() not in endings:
        raise InputError(f"--out {place}: expected a name ending in {', '.join(endings)}")
    compared = compare_runs(options.runs)
    runs.print_compared(compared)
    if place is not None:
        runs.write_compared(place, compared)
        options.say(f"wrote {place}")
    return DONE


def _new(options: argparse.Namespace) -> int:
    from heli_jax.new_config import write_config

    log = Path(options.log)
    out = Path(options.out) if options.out else Path(log.stem).with_suffix(".yaml")
    chosen = (options.model, options.vehicle, options.flight, options.time_rate)
    for found in write_config(log, out, *chosen).notes:
        options.say(found.sentence)
    return DONE


def _keys(options: argparse.Namespace) -> int:
    from heli_jax.config import keys
    from heli_jax.report import document
    from heli_jax.schema_keys import matching

    if options.schema is not None:
        place = Path(options.schema)
        with run_directory.whole_file(place, f"--schema {place}") as temporary:
            text = json.dumps(keys.json_schema(), indent=1)
            temporary.write_text(f"{text}\n", encoding="utf-8")
        options.say(f"wrote {place}")
        return DONE
    found = matching(document.fit_keys() if options.fit else keys.keys(), options.pattern or "")
    if options.json:
        print(json.dumps([key._asdict() for key in found], indent=1))
        return DONE
    if not found:
        hint = ""
        if not options.fit and matching(document.fit_keys(), options.pattern):
            hint = f"; it is a key of fit.json: heli-jax keys --fit {shlex.quote(options.pattern)}"
        raise InputError(f"keys: no key and no meaning contains {options.pattern}{hint}")
    terminal.print_keys(found)
    return DONE


def _models(options: argparse.Namespace) -> int:
    prepare_jax()
    from heli_jax.cli import models

    if options.config is not None:
        if options.name is None:
            raise InputError("--config: expected the NAME of a linear model too, got none")
        models.write_design_config(options.name, Path(options.config))
        options.say(f"wrote {options.config}; next: heli-jax design {options.config}")
    else:
        models.print_models(options.name, as_json=options.json)
    return DONE


def _new_model(options: argparse.Namespace) -> int:
    from heli_jax.new_model import write_skeleton

    written = write_skeleton(options.name, options.out)
    print_text("\n".join(map(str, written)))
    options.say(
        f"wrote {len(written)} files; next: heli-jax simulate {written[2]} --out "
        f"{written[2].with_suffix('.csv')}, then heli-jax fit {written[2]}"
    )
    return DONE
