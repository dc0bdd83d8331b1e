"""Tables of starts that equation error or frequency error found."""

from heli_jax.identification.equation_error.first_guess import EquationErrorStart
from heli_jax.identification.frequency_start import FrequencyErrorStart
from heli_jax.numbers import NOTHING, number, percent, with_sd
from heli_jax.report.tables.table import Table

type Start = EquationErrorStart | FrequencyErrorStart


def start_method(start: Start) -> str:
    """What found the starts, in words."""
    return "equation error" if isinstance(start, EquationErrorStart) else "frequency error"


def first_guess(start: Start) -> Table:
    """Where each free parameter begins, and by what."""
    rows = []
    for name, v in start.values.items():
        shown = with_sd(v.value, v.sd) if v.sd else number(v.value, 4)
        ratio = NOTHING
        if start.selection is not None and name in start.selection.f_ratios:
            ratio = number(start.selection.f_ratios[name], 3)
        rows.append((name, shown, v.unit, v.origin, ratio))
    return Table(("parameter", "start", "unit", "from", "F-ratio"), rows)


def selection_steps(start: Start) -> Table:
    """The steps of a stepwise selection of terms; no rows where there was none."""
    steps = () if start.selection is None else start.selection.steps
    rows = [
        (
            str(i + 1),
            f"{s.parameter} {'in' if s.entered else 'out'}",
            number(s.f_ratio, 3),
            percent(s.r_squared),
        )
        for i, s in enumerate(steps)
    ]
    return Table(("step", "term", "F-ratio", "explained"), rows)
