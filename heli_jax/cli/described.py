"""`heli-jax models NAME`: signals, parameters and modes of a model."""

from typing import Any

from heli_jax import models, naming
from heli_jax.analysis.linear import eigenmodes
from heli_jax.dynamics.model import vehicle_constants
from heli_jax.linear_models.read import linear_model
from heli_jax.numbers import terse
from heli_jax.report.tables import Table
from heli_jax.summaries import Row


def described(text: str) -> tuple[str, dict[str, Table]]:
    """Return name and meaning of a model, and its tables in SI.

    Args:
        text: name of the model as for `models.by_text`.

    Raises:
        InputError: there is no such model, or its file is wrong.
    """
    model, name = models.by_text(text, "models")
    linear = linear_model(name["linear"]) if isinstance(name, dict) else None
    constants = {} if linear is None else linear.vehicle().constants
    meaning = models.listed().get(str(name), "") if linear is None else linear.content.meaning
    records = {"states": model.State, "inputs": model.Inputs, "outputs": model.Outputs}
    head = ("name", "unit", "meaning")
    tables = {title: Table(head, _rows(record)) for title, record in records.items()}
    defaults = vehicle_constants(model)
    sources = {n: c.source for n, c in constants.items()}
    rows = [
        (n, terse(defaults[n], 5), *words, sources.get(n, ""))
        for n, *words in _rows(model.Params)
        if n in defaults
    ]
    head = ("name", "value", "unit", "meaning", "source")
    tables["parameters"] = Table(head, rows)
    if linear is not None:
        modes = [(m, m.eigenvalue.real) for m in eigenmodes(model, linear.vehicle().params)]
        # Time constant of the envelope; it is negative if the mode grows.
        cells = [
            (m.name, *map(terse, (m.frequency, m.damping, -1.0 / real if real else None)))
            for m, real in modes
        ]
        head = ("mode", "frequency [rad/s]", "damping", "time constant [s]")
        tables["modes"] = Table(head, cells)
    return f"{model.name}: {meaning}", tables


def _rows(record: Any) -> list[Row]:
    names = naming.names(record)
    return [(n, naming.unit(record, n) or "", naming.meaning(record, n)) for n in names]
