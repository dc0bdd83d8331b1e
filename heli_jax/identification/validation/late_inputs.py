"""Inputs that are logged later than the machine answered them.

No machine answers before its input. Where an output goes better with what an input does later than
with anything that an input has done, the input is logged late, or it follows the output.
"""

from collections.abc import Sequence

import numpy as np

from heli_jax.flights.flight import Flight
from heli_jax.identification.validation.feedback import Feedback
from heli_jax.identification.validation.finding import Finding
from heli_jax.identification.validation.missing_dynamics import answers

_CLEAR = 0.3
"""correlation with the later input, both whitened, below which nothing is said"""


def late_inputs(
    flights: Sequence[tuple[str, Flight]], feedback: Sequence[Feedback]
) -> list[Finding]:
    """A doubt for each input that an output precedes; by flight the surest output alone.

    Args:
        flights: by what each is called.
        feedback: inputs that follow the response, of which it is said that they may be late.
    """
    said = {(one.flight, one.input) for one in feedback if one.present}
    found = []
    for label, flight in flights:
        surest: dict[str, tuple[float, float, str]] = {}
        for output, y in flight.outputs.items():
            led = _led(y, flight)
            if led is not None and (label, led[2]) not in said:
                size, lead, name = led
                surest[name] = max(surest.get(name, (0.0, 0.0, "")), (size, lead, output))
        found += [_finding(label, name, *one) for name, one in surest.items()]
    return found


def _led(y: np.ndarray, flight: Flight) -> tuple[float, float, str] | None:
    """Of the input that an output precedes the correlation, the lead [s], and the name."""
    every = {n: answers(y, u, flight.dt) for n, u in flight.inputs.items()}
    known = {n: c for n, c in every.items() if c is not None}
    if not known:
        return None
    # Another stick that a pilot moves a little later goes with the answer too: only what beats the
    # answer to every input's past counts.
    past = max(float(c[c.size // 2 :].max()) for c in known.values())
    name, c = max(known.items(), key=lambda item: float(item[1].max()))
    best = int(np.argmax(c))
    if best >= c.size // 2 or not c[best] > max(past, _CLEAR):
        return None
    return float(c[best]), (c.size // 2 - best) * flight.dt, name


def _finding(label: str, name: str, size: float, lead: float, output: str) -> Finding:
    words = (
        f"{label}: {output} moves {lead:.2g} s before {name} does (correlation {size:.2f}, both "
        f"whitened): {name} is logged late (free a delay: nuisance.time_shift, or delays of the "
        "model) or follows the response (feedback)."
    )
    criterion = f"correlation of the output with the later input, {_CLEAR:g}"
    return Finding("late input", "doubt", words, size, criterion)
