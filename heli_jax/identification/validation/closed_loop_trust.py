r"""Which estimates feedback may have moved, where nobody logged an excitation.

What disturbs the machine comes back through the input. That part of an input follows the record's
own innovations, which feedback's detection computes without any model (`feedback`): with $T$ the
response of the input to them, $\hat U = U - T \varepsilon$ is what neither gusts nor noise have
moved. Taken as an instrument in one step from the direct estimate it says how far each estimate
would move, and how surely (Hausman, 1978): what moves by more than its stated error, or may for all
that the record tells, is not to be trusted.

Source: Forssell and Ljung (1999) for the direct estimate's bias and for estimates by projection.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.estimation.frequency_instrument import following
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Solution
from heli_jax.identification.validation.feedback import Feedback, innovations_of

ALLOWED = 2.0
"""stated standard deviations by which feedback may have moved an estimate that is still trusted"""


class Moved(NamedTuple):
    """What feedback may have done to one estimate; both in its stated standard deviations."""

    by: float
    """how far it moves without the part of the inputs that follows gusts and noise"""
    uncertain: float
    """sd of that"""

    @property
    def trusted(self) -> bool:
        """Whether the record excludes that it has moved by more than `ALLOWED`."""
        return bool(abs(self.by) + self.uncertain < ALLOWED)


def moved_by_feedback(
    problem: Problem, at: Solution, found: Sequence[Feedback]
) -> dict[str, Moved]:
    """By unknown of interest; empty where no loop is closed, the method asks for no such look or
    takes the inputs by instrument, or the record is too short for its innovations.

    Args:
        problem: what was fitted.
        at: where the fit ended.
        found: whether inputs follow the response.
    """
    layout, data, noise, z = at
    names = tuple(dict.fromkeys(one.input for one in found if one.present))
    if not names or not layout.estimator.by_instrument:
        return {}
    if data.flights[0].by_instrument is not None:
        return {}
    without = _without_feedback(problem.training, names)
    if without is None:
        return {}
    free = _with_instruments(problem, data, without)
    e = evaluate(layout, free, noise._replace(by_instrument=np.ones(())), z)
    direct = evaluate(layout, data, noise, z)
    q = len(layout.of_interest)
    sd, sd_free = deviations(direct.J)[:q], deviations(e.J)[:q]
    step = -np.linalg.lstsq(np.asarray(e.J), np.asarray(e.r), rcond=1e-10)[0][:q]
    with np.errstate(all="ignore"):
        by, uncertain = step / sd, np.sqrt(np.maximum(sd_free**2 / sd**2 - 1.0, 0.0))
    return {
        n: Moved(*(float(np.nan_to_num(v, nan=np.inf)) for v in pair))
        for n, *pair in zip(layout.of_interest, by, uncertain, strict=True)
    }


def _without_feedback(
    flights: Sequence[Flight], names: Sequence[str]
) -> list[dict[str, np.ndarray]] | None:
    """By flight and input what of it no past innovation has moved (N,)."""
    innovations = [innovations_of(f) for f in flights]
    known = [v for v in innovations if v is not None]
    if len(known) < len(flights) or len({v.shape[1] for v in known}) > 1:
        return None
    parts = following(flights, names, known)
    return [
        {n: u - (part[n] - part[n].mean() if n in names else 0.0) for n, u in f.inputs.items()}
        for f, part in zip(flights, parts, strict=True)
    ]


def _with_instruments(
    problem: Problem, data: Data, inputs: Sequence[dict[str, np.ndarray]]
) -> Data:
    Inputs = problem.model.Inputs
    flights = tuple(
        f._replace(by_instrument=Inputs(**{n: by[n] for n in f.inputs._fields}))
        for f, by in zip(data.flights, inputs, strict=True)
    )
    return jax.device_put(data._replace(flights=flights))


def trust_notes(moved: dict[str, Moved]) -> list[str]:
    """Which parameters a fit in closed loop cannot be trusted on, in words; nothing where no loop
    was found.

    Args:
        moved: of `moved_by_feedback`.
    """
    if not moved:
        return []
    doubted = {n: m for n, m in moved.items() if not m.trusted}
    if not doubted:
        return [
            "Closed loop without an instrument: without the part of the inputs that follows gusts "
            f"and noise no estimate moves by as much as {ALLOWED:g} standard deviations."
        ]
    words = ", ".join(f"{n} ({m.by:+.1f} ± {m.uncertain:.1f})" for n, m in doubted.items())
    rest = [n for n in moved if n not in doubted]
    return [
        "Closed loop without an instrument: this fit cannot be trusted on "
        f"{', '.join(doubted)}. Without the part of the inputs that follows gusts and noise these "
        f"move by more than their intervals allow ({words} standard deviations)"
        + (f"; {', '.join(rest)} hold. " if rest else ". ")
        + "Remedy: log the excitation and name it (signals.instruments), or method: filter-error "
        "with a disturbance."
    ]
