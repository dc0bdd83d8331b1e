"""Registry of the estimation methods.

Each method is an `Objective` (`estimation/objective.py`) in its own file. Entries name module and
object, so that a problem can be stated before estimators are imported.
"""

import importlib
from typing import Any, NamedTuple

from heli_jax.errors import nearest


class Method(NamedTuple):
    """One estimation method."""

    home: str
    """Place of its Objective, `module:object`."""
    label: str
    """Name in reports."""


# Names instead of imports: estimators import the problem, which in turn needs this table.
_ESTIMATION = "heli_jax.identification.estimation"

METHODS = {
    "output-error": Method(f"{_ESTIMATION}.output_error:OBJECTIVE", "output error"),
    "filter-error": Method(f"{_ESTIMATION}.filter_error:OBJECTIVE", "filter error"),
    "frequency-error": Method(f"{_ESTIMATION}.frequency_error:OBJECTIVE", "frequency error"),
    "frequency-response": Method(
        f"{_ESTIMATION}.frequency_response:OBJECTIVE", "frequency response"
    ),
}


def objective_of(method: str) -> Any:
    """Return the Objective of a method.

    The type is Any because the module of its class imports this one.

    Args:
        method: its name in `METHODS`.

    Raises:
        ValueError: unknown method.
    """
    if method not in METHODS:
        # The value is cut because a configuration may hold anything here.
        raise ValueError(
            f"method: expected one of {', '.join(METHODS)}, got {method!r:.60}"
            f"{nearest(str(method)[:60], METHODS)}"
        )
    module, _, name = METHODS[method].home.partition(":")
    return getattr(importlib.import_module(module), name)
