"""Findings on residuals that still follow an input, the amplitude, or time."""

from collections.abc import Iterator

from heli_jax.finding import Finding, found
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.validation.unmodelled import LEVEL, LEVEL_COLOURED

RESIDUAL_FOLLOWS_INPUT = "dynamics.residual-follows-input"
_CODES = {
    "input": RESIDUAL_FOLLOWS_INPUT,
    "amplitude": "dynamics.depends-on-amplitude",
    "flights": "dynamics.flights-differ",
    "time": "dynamics.changes-over-record",
}


def unmodelled_dynamics(c: Context) -> Iterator[Finding]:
    """Find a missing mode, or a response that depends on amplitude, flight or time."""
    for one in c.unmodelled[0]:
        yield found(
            _CODES[one.drive.kind],
            "doubt",
            one.output,
            *one.drive.of,
            value=one.p_value,
            shifts=one.shifts,
            distrusts=one.far,
            output=one.output,
            of=one.drive.of,
            gain=one.gain,
            near=f"{one.frequency:.2g} rad/s" if one.frequency else "",
            lacks="a mode or a lag" if one.frequency else "dynamics",
            level=LEVEL,
        )


def inputs_prefer_other_values(c: Context) -> Iterator[Finding]:
    """Find parameters whose values by the response to the inputs alone differ from the fit's."""
    p, shifts = c.unmodelled[1]
    if shifts:
        yield found(
            "agreement.inputs-ask-otherwise",
            "doubt",
            *c.at.layout.of_interest,
            value=p,
            shifts=shifts,
            level=LEVEL_COLOURED,
        )
