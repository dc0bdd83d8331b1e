"""Options of the commands that have many, and what reads their values."""

import argparse
import contextlib
import math
from typing import TYPE_CHECKING, Any

from heli_jax.errors import InputError

if TYPE_CHECKING:
    from heli_jax.flights.convert import Selection

EXIT_CODES = (
    "Exit codes: 0 done; 2 wrong input, in one sentence; 3 the data cannot determine what was "
    "asked, or an interval is not trusted; 4 an optimiser did not converge, the model is not "
    "adequate, or sensors are not compatible; 130 interrupted."
)
"""what `--help` ends with: of every command"""


def add_fit_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax fit`."""
    command.add_argument("--out", metavar="DIR", help="directory (default: runs/NAME-DATE-TIME)")
    study = command.add_argument_group(
        "a study of fits",
        "where a key takes several values: --over, --set repeated with one KEY, or study in CONFIG "
        "(docs/studies.md)",
    )
    study.add_argument(
        "--over",
        action="append",
        default=[],
        metavar="KEY=VALUE,VALUE",
        help="fit with each value, with several keys each combination",
    )
    study.add_argument(
        "--resume", action="store_true", help="go on where the study in --out was ended"
    )
    study.add_argument(
        "--reports", action="store_true", help="write each fit's page too: it takes seconds"
    )
    where = study.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=count, metavar="N", help="processes (default: as many as cores)"
    )
    where.add_argument(
        "--scheduler", metavar="tcp://HOST:8786", help="fit on the workers of this dask scheduler"
    )


def add_simulate_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax simulate`."""
    command.add_argument(
        "--out",
        metavar="FILE",
        help=".csv or .parquet (default: CSV on stdout); missing folders on its way are made",
    )
    command.add_argument(
        "--view",
        nargs="?",
        const="",
        metavar="HTML",
        help="also a page with figures and the flight in 3D (default: beside --out)",
    )


def add_sweep_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax sweep`."""
    command.add_argument("--out", metavar="DIR", help="directory (default: runs/NAME-DATE-TIME)")
    command.add_argument(
        "--resume", action="store_true", help="go on where the sweep in --out was ended"
    )
    command.add_argument(
        "--devices", type=count, metavar="N", help="processor cores or GPUs to use (default: all)"
    )
    command.add_argument("--no-figures", action="store_true", help="draw none: it takes seconds")
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=count, metavar="N", help="compute in N processes of a local dask cluster"
    )
    where.add_argument(
        "--scheduler",
        metavar="tcp://HOST:8786",
        help="compute on the workers of this dask scheduler",
    )


def add_time_rate(command: argparse.ArgumentParser) -> None:
    """The rate of a table that has no times."""
    command.add_argument(
        "--time-rate",
        type=float,
        metavar="HZ",
        help="of a table without times: samples a second",
    )


def add_info_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax info`."""
    command.add_argument("log", metavar="LOG", help="a table or an autopilot's log: docs/logs.md")
    command.add_argument("--time", metavar="NAME", help="of a table: the column of time stamps")
    command.add_argument("--time-unit", metavar="UNIT", help="of the stamps: s, ms, us or ns")
    add_time_rate(command)
    command.add_argument("--flight", type=count, metavar="N", help="this one alone (from 1)")
    command.add_argument("--channels", metavar="PATTERN", help="list these: 'vehicle_attitude*'")
    command.add_argument("--json", action="store_true", help="everything, for other programs")


def add_convert_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("log", metavar="LOG", help="a table or an autopilot's log: docs/logs.md")
    command.add_argument("out", metavar="OUT", help=".csv, .parquet or .nc")
    command.add_argument(
        "--signals",
        nargs="+",
        default=[],
        metavar="NAME",
        help="'vehicle_attitude.*', 'euler(vehicle_attitude.q).roll' (default all)",
    )
    command.add_argument("--preset", metavar="NAME", help="its signals, by its names and in SI")
    command.add_argument(
        "--config",
        metavar="CONFIG",
        help="the signals of its first flight, by the model's names and in SI; or its swashplate, "
        "for --signals ccpm.roll",
    )
    command.add_argument("--rate", type=float, metavar="HZ", help="resample to this rate")
    command.add_argument(
        "--window", nargs=2, type=float, metavar=("FROM", "TO"), help="[s] from the log's beginning"
    )
    command.add_argument("--flight", type=count, metavar="N", help="of a log of several (from 1)")
    command.add_argument("--time", metavar="NAME", help="of a table: the column of time stamps")
    command.add_argument("--time-unit", metavar="UNIT", help="of the stamps: s, ms, us or ns")
    add_time_rate(command)


def selection(options: argparse.Namespace) -> "Selection":
    """What `heli-jax convert` takes of a log.

    Raises:
        InputError: options that exclude one another, or no such preset.
    """
    from heli_jax.flights import convert, named

    if options.preset is not None and (options.signals or options.config is not None):
        other = "--signals" if options.signals else "--config"
        raise InputError(f"--preset: names the columns, expected it without {other}")
    by_preset = None
    if options.preset is not None:
        try:
            by_preset = named.by_preset(options.preset)
        except ValueError as e:
            raise InputError(f"--preset: {e}") from e
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


def add_frf_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax frf`."""
    command.add_argument(
        "log", nargs="?", metavar="LOG", help="read as the configuration's first (default: its own)"
    )
    command.add_argument("--out", metavar="DIR", help="directory (default: runs/NAME-DATE-TIME)")


def add_runs_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax runs`."""
    command.add_argument(
        "directory", nargs="?", default="runs", metavar="DIR", help="default: runs"
    )
    command.add_argument("--json", action="store_true", help="for other programs")


def add_compare_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax compare`."""
    command.add_argument("runs", nargs="+", metavar="RUN", help="directories of heli-jax fit")
    command.add_argument(
        "--out", metavar="FILE", help="page (.html), estimates as .csv or as LaTeX (.tex)"
    )


def add_new_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax new`."""
    command.add_argument("log", metavar="LOG", help="of any format")
    command.add_argument(
        "--model",
        metavar="NAME",
        help="as a configuration names it, such as roll-on-stand or attitude-flybarless "
        "(default: the linear model of the axis whose stick moves most)",
    )
    command.add_argument("--vehicle", metavar="FILE", help="a vehicle file that is there already")
    command.add_argument("--flight", type=count, metavar="N", help="of a log that holds several")
    add_time_rate(command)
    command.add_argument("--out", metavar="FILE", help="configuration (default: the log's name)")


def add_keys_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax keys`."""
    command.add_argument(
        "pattern", nargs="?", metavar="TEXT", help="of keys or their meaning (default: all keys)"
    )
    command.add_argument("--json", action="store_true", help="for other programs")
    command.add_argument(
        "--schema", metavar="FILE", help="write the JSON schema, by which editors complete YAML"
    )
    command.add_argument("--fit", action="store_true", help="what stands in fit.json instead")


def count(text: str) -> int:
    """An option's value that is a number from 1."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number from 1, got {text!r}")
    return int(text)


def add_windows_options(command: argparse.ArgumentParser) -> None:
    """Of `heli-jax windows`."""
    command.add_argument(
        "log", nargs="?", metavar="LOG", help="read as the configuration's first (default: its own)"
    )
    command.add_argument(
        "--length",
        type=seconds,
        metavar="S",
        help="of a window [s] (default: a twelfth)",
    )


def seconds(text: str) -> float:
    """An option's value that is a time."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"expected a number of seconds above 0, got {text!r}")
    return value


# Any: dask.distributed is an extra, and only `sweeps.cluster` names its classes.
def dask_client(options: argparse.Namespace) -> contextlib.AbstractContextManager[Any]:
    """A dask client where one is asked for.

    Args:
        options: of a command with --workers and --scheduler.

    Raises:
        InputError: dask is not installed, or nothing answers.
    """
    if options.scheduler is None and options.workers is None:
        return contextlib.nullcontext()
    try:
        from heli_jax.sweeps.cluster import connected
    except ImportError as e:
        option = "--workers" if options.scheduler is None else "--scheduler"
        raise InputError(
            f"{option}: dask.distributed is not installed, expected the extra distributed: "
            "pip install 'heli_jax[distributed]'"
        ) from e
    return connected(options.scheduler, options.workers)
