"""fit and check: parameters with intervals and a verdict, from a Problem."""

import time
from typing import NamedTuple

from jaxtyping import Array

from heli_jax.identification.agreement import signals_of
from heli_jax.identification.assemble import Ran, assemble, noise_by_name
from heli_jax.identification.estimation import multistart as starting
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.disturbance_search import disturbance_or_none
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.multistart import StartRow
from heli_jax.identification.estimation.noise_covariance import (
    better_of_two_guesses,
    first_noise,
    relax_noise_covariance,
)
from heli_jax.identification.estimation.shooting_start import SAID, by_windows
from heli_jax.identification.identifiability.sensitivity import verdict_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Check, Estimate, Fit, Signals, Status
from heli_jax.identification.unknowns.initial_guess import start_vector
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    layout_of,
    unpack,
)
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation import excitation
from heli_jax.identification.validation.other_hold import other_hold

__all__ = ["Check", "Estimate", "Fit", "Signals", "StartRow", "Status", "check", "fit"]

_FIRST_STEPS = 40


class _Begin(NamedTuple):
    """A problem at its first guess."""

    layout: Layout
    data: Data
    noise: Noise
    z: Array
    e: Evaluation


def _begin(problem: Problem) -> _Begin:
    layout, data = layout_of(problem, problem.training), data_of(problem, problem.training)
    noise = first_noise(problem, problem.training)
    z = starting.first_guess(layout, data, noise, start_vector(layout, data, problem))
    e = evaluate(layout, data, noise, z)
    level = layout.estimator.with_level(data, e, noise)
    if level is not noise:
        noise = level
        e = evaluate(layout, data, noise, z)
    return _Begin(layout, data, noise, z, e)


def check(problem: Problem) -> Check:
    """What the flights can determine, judged at the start values, before any fit.

    The noise is as stated, or guessed from the third differences of the measured signals.
    """
    begin = _begin(problem)
    e = begin.e
    verdict = verdict_of(problem, begin.layout, e)
    runs = tuple(s.simulated for s in signals_of(e, problem.training))
    notes = excitation.notes(problem, runs, begin.noise.sd)
    lost = (*verdict.undetermined, *verdict.without_effect)
    notes += other_hold(problem, *begin[:4], e, skip=lost)
    scales = unpack(begin.layout, begin.data, begin.z).scales
    guessed = tuple(
        f"{label}/{name}"
        for label, flight in zip(labels(problem.training), problem.training, strict=True)
        for name in flight.outputs
        if name not in flight.sd
    )
    sds = noise_by_name(problem, begin.layout, begin.noise, scales)
    return Check(verdict, sds, tuple(notes), guessed)


def fit(
    problem: Problem,
    *,
    starts: int = 1,
    seed: int = 0,
    max_steps: int = 200,
    progress: starting.Progress | None = None,
) -> Fit:
    """Estimate the free parameters by the problem's method: output error or filter error.

    Args:
        starts: how many points to start from; the first is the given one, the others are drawn
            within the bounds, or about a factor of three around the start.
        seed: of that draw.
        progress: told in words what is going on.

    Returns:
        A Fit whose `status` says whether it converged and whether the data determine what was
        asked. Cramér-Rao intervals; those of output error allow for residuals that are not white
        (`coloured`), and `narrow` says where nothing does.
    """
    start = time.perf_counter()
    tell = progress or (lambda _: None)
    begin = _begin(problem)
    before = verdict_of(problem, begin.layout, begin.e)
    tell(f"fitting {', '.join(begin.layout.of_interest)}")
    points = starting.draw(begin.layout, problem, begin.z, starts, seed)
    asked = "sigma_w" in begin.layout.disturbance
    # Without a disturbance in the record the filter's optimiser finds no end: it is cut short,
    # and goes on only where there is one.
    short = min(max_steps, _FIRST_STEPS) if asked else max_steps
    search = starting.Search(problem, begin.layout, begin.data, short)
    runs = search.run(begin.noise, points, tell)
    best, said = min(runs, key=starting.rank), ()
    other = by_windows(problem, search, begin.noise, begin.e, begin.z, best)
    if other is not None:
        best, said = other, (SAID,)
    settled = relax_noise_covariance(search, begin.noise, best)
    settled = settled._replace(notes=(*said, *settled.notes))
    settled = better_of_two_guesses(search, points, settled, problem.training)
    search.max_steps = max_steps
    if asked:
        settled = disturbance_or_none(search, settled)
    timing = {"fit": time.perf_counter() - start}
    return assemble(problem, search, settled, Ran(before, points, runs, seed, timing))
