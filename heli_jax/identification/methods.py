"""The methods of estimation by name: the one place where a new one is entered.

A method is an `Objective` (`estimation/objective.py`) in a file of its own. Entries name it by
module and object, so that a problem can be stated before anything that solves it is imported.
"""

import importlib
from typing import Any, NamedTuple

from heli_jax.errors import nearest


class Method(NamedTuple):
    """One way to estimate."""

    home: str
    """`module:object` of its Objective"""
    label: str
    """as reports call it"""


# By name: estimators import the problem, and a problem asks here which methods there are.
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
    """The Objective of a method.

    Typed Any since its class stands above this module in the order of imports.

    Args:
        method: its name in `METHODS`.

    Raises:
        ValueError: there is no such method.
    """
    if method not in METHODS:
        # Cut: a configuration may hold anything in this place.
        raise ValueError(
            f"method: expected one of {', '.join(METHODS)}, got {method!r:.60}"
            f"{nearest(str(method)[:60], METHODS)}"
        )
    module, _, name = METHODS[method].home.partition(":")
    return getattr(importlib.import_module(module), name)
