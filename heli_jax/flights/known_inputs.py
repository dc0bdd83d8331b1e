"""The rows of a table in which its inputs are known."""

from collections.abc import Mapping

import numpy as np

from heli_jax.finding import Finding, note
from heli_jax.flights.onto_grid import FEWEST
from heli_jax.flights.request import Request
from heli_jax.flights.table import shown


def rows_of_known_inputs(
    request: Request, numbers: Mapping[str, np.ndarray], seconds: np.ndarray, rows: slice
) -> tuple[slice, tuple[Finding, ...]]:
    """The rows without those before an input's first value or behind its last, and a note of it.

    An input is somewhere all the time, and where it was before its first value nobody knows: a
    table whose cells are filled with the last value begins so, with the topic that came first.

    Args:
        request: which columns are inputs.
        numbers: the columns (N,), NaN where a cell is empty.
        seconds: of the rows (N,) [s], from the first.
        rows: those that are asked for.
    """
    first, stop, cut = rows.start, rows.stop, []
    inputs = (s.name for (_, kind), s in request.signals.items() if kind == "input")
    for name in dict.fromkeys(inputs):
        known = np.flatnonzero(~np.isnan(numbers[name][rows]))
        # Of a column without any value the first row is told.
        if not known.size or known[-1] - known[0] + 1 == rows.stop - rows.start:
            continue
        first = max(first, rows.start + int(known[0]))
        stop = min(stop, rows.start + int(known[-1]) + 1)
        cut.append(name)
    if not cut or stop - first < FEWEST:
        return rows, ()
    where = f"from {seconds[first]:.6g} s to {seconds[stop - 1]:.6g} s"
    count = (rows.stop - rows.start) - (stop - first)
    many = "1 row is" if count == 1 else f"{count} rows are"
    have = "has" if len(cut) == 1 else "have"
    words = f"{', '.join(map(shown, cut))} {have} no value before or behind, and {many} left out"
    left_out = note("windows.inputs-known", f"the flight is {where}: {words}", *cut, value=count)
    return slice(first, stop), (left_out,)
