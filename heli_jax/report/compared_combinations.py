"""What several fits say of the combinations, such as a/Ixx, that one of them alone determines."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

from heli_jax.identification.identifiability.verdict import Z95
from heli_jax.identification.result import Estimate
from heli_jax.report.saved_fit import SavedFit

_SI = "SI"
"""the unit: that of a product of powers has no name"""


def combinations(runs: Sequence[SavedFit]) -> list[dict[str, Estimate]]:
    """By run the combinations that any of them determines without determining their parts.

    A run that determines the parts themselves has them by its estimates, their correlations, and
    the constants that it took as known; one that has neither lacks that entry. `sd` is None where
    it has the parts and the data do not determine the combination.

    Args:
        runs: what `load_fit` read.
    """
    stated = [_stated(run) for run in runs]
    exponents = {n: c["exponents"] for of in stated for n, c in of.items()}
    kinds = {n: c.get("kind", "product") for of in stated for n, c in of.items()}
    by_run: list[dict[str, Estimate]] = []
    for run, of in zip(runs, stated, strict=True):
        estimates = {}
        for name, powers in exponents.items():
            if name in of:
                estimates[name] = _estimate(*(of[name][key] for key in _NUMBERS))
            elif kinds[name] == "product" and (made := _from_parts(run, powers)) is not None:
                estimates[name] = made
        by_run.append(estimates)
    return by_run


_NUMBERS = ("value", "sd", "lower95", "upper95")


# Any: what fit.json holds.
def _stated(run: SavedFit) -> dict[str, dict[str, Any]]:
    """What the fit itself says that the data determine; nothing of one without an optimum."""
    if run.status == "not-converged":
        return {}
    every = run.content.get("determined_combinations") or ()
    return {c["name"]: c for c in every if all(c.get(key) is not None for key in _NUMBERS)}


def _from_parts(run: SavedFit, powers: Mapping[str, float]) -> Estimate | None:
    """A product of powers of a run's estimates and constants; None where it has not all of them.

    Raises nothing: of a number below zero, whose power may not exist, there is none.
    """
    constants = run.content.get("constants") or {}
    free = [n for n in powers if n in run.estimates]
    if not free or any(n not in run.estimates and n not in constants for n in powers):
        return None
    parts = {n: run.estimates[n] for n in free}
    if any(e.sd is None for e in parts.values()):
        return _estimate(math.nan, None, None, None)
    values = {n: parts[n].value if n in parts else constants[n] for n in powers}
    correlation = _correlation(run, free)
    if correlation is None or any(not v > 0.0 for v in values.values()):
        return None
    value = math.prod(values[n] ** power for n, power in powers.items())
    # Of logarithms, in which a product is a sum.
    logs = {n: powers[n] * (parts[n].sd or 0.0) / values[n] for n in free}
    variance = sum(
        logs[a] * logs[b] * correlation[a, b] for a, b in itertools.product(free, repeat=2)
    )
    sd = math.sqrt(max(variance, 0.0))
    return _estimate(value, value * sd, value * math.exp(-Z95 * sd), value * math.exp(Z95 * sd))


def _correlation(run: SavedFit, names: Sequence[str]) -> dict[tuple[str, str], float] | None:
    """Between estimates of a run, by their names; None where fit.json does not say."""
    if len(names) == 1:
        return {(names[0], names[0]): 1.0}
    verdict = run.content.get("verdict") or {}
    order, rows = verdict.get("names") or [], verdict.get("correlation") or []
    if any(n not in order for n in names):
        return None
    at = {n: order.index(n) for n in names}
    return {(a, b): rows[at[a]][at[b]] for a, b in itertools.product(names, repeat=2)}


def _estimate(value: float, sd: float | None, lower: float | None, upper: float | None) -> Estimate:
    return Estimate(value, sd, lower, upper, _SI, math.nan, 0.0, False)
