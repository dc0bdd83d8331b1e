"""The table of several methods side by side."""

from heli_jax.identification.method_comparison import MethodComparison, MethodResult
from heli_jax.numbers import NOTHING, measured
from heli_jax.report.tables.table import NOT_DETERMINED, Table


def methods(comparison: MethodComparison) -> Table:
    """Estimates with 95 % intervals by parameter and method, differences in joint sd."""
    main, *others = comparison.results
    assert main.fit is not None
    head = ["", main.label]
    for other in others:
        head += [other.label, "difference [joint sd]"]
    rows = [_row(comparison, name) for name in comparison.names]
    verdicts, times = ["verdict", main.word], ["time", _seconds(main)]
    for other in others:
        verdicts += [other.word, ""]
        times += [_seconds(other), ""]
    return Table(tuple(head), [*rows, tuple(verdicts), tuple(times)])


def _row(comparison: MethodComparison, name: str) -> tuple[str, ...]:
    main, *others = comparison.results
    cells = [name, _cell(comparison, main, name)]
    for other in others:
        d = comparison.difference(other, name)
        cells += [
            _cell(comparison, other, name),
            NOTHING if d is None else f"{d:+.1f}".replace("-", "−"),
        ]
    return tuple(cells)


def _cell(comparison: MethodComparison, result: MethodResult, name: str) -> str:
    """`0.02403 (0.02395 to 0.02411)`"""
    e = comparison.estimate(result, name)
    if e is None:
        return NOTHING
    if e.sd is None:
        return NOT_DETERMINED
    value, low, high, _ = measured(e.sd, e.value, e.lower95, e.upper95)
    return f"{value} (not trusted)" if e.lower95 is None else f"{value} ({low} to {high})"


def _seconds(result: MethodResult) -> str:
    return f"{result.seconds:.1f} s" if result.fit is not None else NOTHING
