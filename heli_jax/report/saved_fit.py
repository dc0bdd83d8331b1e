"""A fit read back from its run directory, as plain data without model and log."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from heli_jax.errors import InputError, require_kind
from heli_jax.identification.result import Estimate, Signals
from heli_jax.identification.validation.metrics import Metrics
from heli_jax.numbers import adequacy_of
from heli_jax.regular_file import read_regular
from heli_jax.report.document import checked
from heli_jax.summaries import as_text, of_estimates

if TYPE_CHECKING:
    import pandas as pd

_LIMIT_BYTES = 1_000_000_000
"""Largest size of each file [bytes]."""


class SavedFit(NamedTuple):
    """Content of fit.json and signals.csv, with the names of `Fit`."""

    directory: Path
    model: str
    method: str
    status: str
    verdict: str
    """Text of the identifiability analysis."""
    identifiable: bool
    adequate: bool | None
    """True if the model explains the record; None if not judged."""
    estimates: dict[str, Estimate]
    nuisance: dict[str, Estimate]
    intervals: dict[str, dict[str, tuple[float, float]]]
    """95 % intervals by parameter and method: 'gaussian', and the requested ones."""
    metrics: dict[str, Metrics]
    """Metrics of the simulation by output, over the fitted flights."""
    validation: dict[str, Metrics]
    """Metrics of the simulation by output, over the held-out flights."""
    signals: tuple[Signals, ...]
    notes: tuple[str, ...]
    """Sentences of the findings."""
    untrusted: tuple[str, ...]
    """Parameters with unusable intervals."""
    content: dict[str, Any]
    """Complete content of fit.json."""

    @property
    def adequacy(self) -> str:
        """`yes`, `no (...)` or `not judged`, as in the fit."""
        return adequacy_of(self.content)

    @property
    def distrust(self) -> str:
        """`Not trusted: ...`; empty if all intervals are trusted."""
        return self.content.get("distrust") or ""

    @property
    def overconfident(self) -> bool:
        """True if the intervals are too narrow because residuals are not white."""
        return bool((self.content.get("residuals") or {}).get("overconfident", False))

    def to_dataframe(self, *, nuisance: bool = False) -> "pd.DataFrame":
        """Return the estimates as a pandas data frame, like `Fit.to_dataframe`.

        Args:
            nuisance: append initial states, biases, gains and offsets.
        """
        from heli_jax.exports import estimates_frame

        return estimates_frame({**self.estimates, **(self.nuisance if nuisance else {})})

    def __repr__(self) -> str:
        head, rows = of_estimates(self.estimates)
        title = f"SavedFit of {self.model} by {self.method}: {self.status}, in {self.directory}"
        return as_text(title, head, rows, (self.verdict, *self.notes))


def load_fit(directory: str | Path) -> SavedFit:
    """Read the run directory of an earlier fit.

    Raises:
        InputError: it contains no fit.json and signals.csv of a fit.
        TypeError: it is no path.
    """
    require_kind("directory", directory, (str, Path), "the path of a fit's run directory")
    directory = Path(directory)
    if not (directory / "fit.json").exists():
        got = "a file" if directory.exists() else "nothing of that name"
        if directory.is_dir():
            got = "a folder without fit.json"
        raise InputError(
            f"{directory}: expected the run directory of a fit (heli-jax fit --out DIR), got {got}"
        )
    data = read_regular(directory / "fit.json", "the fit.json of a run directory", _LIMIT_BYTES)
    table = directory / "signals.csv"
    try:
        content = checked(data)
        text = read_regular(table, "the signals.csv of a run directory", _LIMIT_BYTES)
        return _saved(directory, content, text.decode("utf-8"))
    except InputError:
        raise
    # A key is missing or has another kind, a row is incomplete, or a cell is no number.
    except (
        LookupError,
        TypeError,
        AttributeError,
        ValueError,
        OverflowError,
        RecursionError,
        csv.Error,
    ) as e:
        raise InputError(
            f"{directory}: expected fit.json and signals.csv as heli-jax fit writes them, got "
            f"other content ({type(e).__name__}: {e})"
        ) from e


def _saved(directory: Path, content: dict[str, Any], table: str) -> SavedFit:
    # Fixed parameters are no estimates.
    free = {n: e for n, e in content["parameters"].items() if not e.get("fixed", False)}
    estimates = _records(Estimate, free)
    by_method = {n: {"gaussian": (e.lower95, e.upper95)} for n, e in estimates.items()}
    if content["intervals"] is not None:
        by_method = content["intervals"]["by_parameter"]
    intervals = {
        name: {how: (_number(low), _number(high)) for how, (low, high) in by.items()}
        for name, by in by_method.items()
    }
    return SavedFit(
        directory=directory,
        model=content["model"],
        method=content["method"],
        status=content["status"],
        verdict=content["verdict"]["text"],
        identifiable=content["identifiable"],
        adequate=content["adequate"],
        estimates=estimates,
        nuisance=_records(Estimate, content["nuisance"]),
        intervals=intervals,
        metrics=_records(Metrics, content["metrics"]),
        validation=_records(Metrics, content["validation"]),
        signals=_signals(table, content),
        notes=tuple(f["sentence"] for f in content.get("findings", ()) if f["severity"] != "ok"),
        untrusted=tuple(content.get("untrusted", {})),
        content=content,
    )


def _records[R: (Estimate, Metrics)](
    kind: type[R], saved: Mapping[str, Mapping[str, Any]]
) -> dict[str, R]:
    """Return records by name, from the keys of their fields."""
    # null represents NaN.
    numbers = ("value", *Metrics._fields)
    made = {}
    for name, e in saved.items():
        values: list[Any] = [_number(e[f]) if f in numbers else e[f] for f in kind._fields]
        made[name] = kind(*values)
    return made


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _signals(text: str, content: Mapping[str, Any]) -> tuple[Signals, ...]:
    """Return the flights of signals.csv; NaN for an empty cell."""
    held_out = {flight["flight"]: flight.get("hold_out", False) for flight in content["data"]}
    # An output may be measured only in held-out flights.
    outputs = list(dict.fromkeys([*content["metrics"], *content["validation"]]))
    # Flight names come from files and may contain commas, so split(",") would fail.
    lines = csv.reader(text.splitlines())
    head = next(lines, [])
    if head[:2] != ["flight", "time"]:
        raise ValueError(f"signals.csv: expected the columns flight and time, got {head[:2]}")
    rows: dict[str, list[list[str]]] = {}
    for line in lines:
        rows.setdefault(line[0], []).append(line[1:])
    return tuple(
        _flight(name, held_out.get(name, False), head[1:], cells, outputs)
        for name, cells in rows.items()
    )


def _flight(
    name: str, hold_out: bool, head: list[str], cells: list[list[str]], outputs: list[str]
) -> Signals:
    table = np.array([[float(c) if c else math.nan for c in row] for row in cells])
    # A signal that a flight lacks is an empty column.
    columns = {n: v for n, v in zip(head, table.T, strict=True) if not np.isnan(v).all()}
    measured, simulated, _, innovations = (
        {o: columns.pop(f"{o}_{what}") for o in outputs if f"{o}_{what}" in columns}
        for what in ("measured", "simulated", "residual", "innovation")
    )
    times = columns.pop("time")
    log = columns.pop("log_time", None)  # missing in earlier versions, and without a log
    start = None if log is None else float(log[0] - times[0])
    # The remaining columns are inputs.
    return Signals(name, hold_out, times, columns, measured, simulated, innovations or None, start)
