"""What the nuisance unknowns are called: initial states, biases, input offsets of every flight."""

from typing import NamedTuple

from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Layout


class WeakUnknown(NamedTuple):
    """An unknown of one flight that has a weak prior of ten times the signal."""

    label: str
    """as the fit names it: 'flight 1/bias p'"""
    kind: str
    """the switch in `Nuisance` that it belongs to"""
    words: str
    """as a sentence names it, whichever flight it belongs to: 'the bias of p'"""


def weak_unknowns(problem: Problem, layout: Layout) -> tuple[WeakUnknown, ...]:
    """The unknowns from `layout.first_nuisance` on, in their order."""
    found = []
    for label, outputs, (count, _) in zip(
        labels(problem.training), layout.outputs, layout.windows, strict=True
    ):
        for k in range(count):
            ending = f" of window {k + 1}" if count > 1 else ""
            found += [
                WeakUnknown(f"{label}/initial {n}{ending}", "initial_state", f"the initial {n}")
                for n in layout.states
            ]
        if layout.bias:
            found += [WeakUnknown(f"{label}/bias {n}", "bias", f"the bias of {n}") for n in outputs]
        found += [
            WeakUnknown(f"{label}/offset {n}", "input_offset", f"the offset of {n}")
            for n in layout.offsets
        ]
    size = layout.size - layout.first_nuisance
    # One that is not listed here is left without a name, not taken for another.
    if len(found) != size:
        found = [WeakUnknown(f"nuisance {i + 1}", "", "a nuisance") for i in range(size)]
    return tuple(found)


def can_be_off(problem: Problem, kind: str) -> bool:
    """Whether the problem would be one without this kind of nuisance: windows need their states."""
    return bool(kind) and not (kind == "initial_state" and problem.window is not None)


def labels(flights: tuple[Flight, ...]) -> list[str]:
    """What to call each flight; of several with one name the second and further have a number."""
    names = [f.name or f"flight {i + 1}" for i, f in enumerate(flights)]
    before = [names[:i].count(name) for i, name in enumerate(names)]
    return [f"{name} ({k + 1})" if k else name for name, k in zip(names, before, strict=True)]
