"""What outputs would tell that the model has and the log lacks, by Fisher's information.

The Jacobian at the start values is that of the fit, with rows of further outputs as the model shows
them; how much narrower each interval would be follows from the rows alone.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.finding import Finding
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.measured_signals import signal_numbers, signals
from heli_jax.identification.identifiability.expected import (
    Sensitivity,
    expected_sd,
    sensitivity_at,
    triangle,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Solution, layout_of

_WORTH = 0.9
"""of an interval's width, below which an output is spoken of"""
_DOUBT = 0.5
"""of an interval's width: an output that halves it is missed"""
_KNOWN = 0.1
"""relative sd of a parameter below which nothing is missed"""
TYPICAL = {"rad": 0.01, "rad/s": 0.01, "m": 0.5, "m/s": 0.1, "m/s^2": 0.3}
"""noise of small autopilots' sensors (attitude, gyro, GPS position and velocity, accelerometer),
SI, by unit: for outputs of a unit that no measured output has"""
_MOST_NAMED = 3
"""outputs that are named, those that narrow an interval most"""


class MissingOutput(NamedTuple):
    """One output that the log lacks."""

    name: str
    sd: float
    """of the noise that it is taken to have [SI]"""
    ratios: Float[np.ndarray, " q"]
    """sd of each parameter of interest with it, over that without; 0 where only it determines"""
    before: Float[np.ndarray, " q"]
    """relative sd of each without it"""


def missing_outputs(problem: Problem, at: Solution) -> list[Finding]:
    """What each output that the model has and the log lacks would do to the intervals.

    Args:
        problem: what is free.
        at: layout, data, noise and unknowns at the start values.
    """
    looked = look_at_missing(problem, at)
    if looked is None:
        return []
    unknowns, missing = looked
    if not missing:
        return []
    criterion = f"width of an interval with the output, over that without; {_DOUBT:g}"
    missing = sorted(missing, key=lambda m: float(np.min(m.ratios)))
    worth = [m for m in missing if float(np.min(m.ratios)) < _WORTH][:_MOST_NAMED]
    if not worth:
        words = (
            f"of the model's outputs that are not used none would narrow an interval by more than "
            f"{100 * (1 - _WORTH):.0f} % (most {missing[0].name})."
        )
        return [
            Finding(
                "excitation.missing-output",
                "ok",
                words,
                float(np.min(missing[0].ratios)),
                criterion,
            )
        ]
    return [_finding(problem, unknowns, m, criterion) for m in worth]


def _finding(
    problem: Problem, unknowns: tuple[str, ...], m: MissingOutput, criterion: str
) -> Finding:
    order = [i for i in np.argsort(m.ratios) if m.ratios[i] < _WORTH][:_MOST_NAMED]
    parts = [
        f"that of {unknowns[i]} would be {m.ratios[i]:.2g} times as wide"
        if m.ratios[i] > 0
        else f"{unknowns[i]} would be determined"
        for i in order
    ]
    unit = naming.unit(problem.model.Outputs, m.name) or ""
    least = float(np.min(m.ratios))
    words = (
        f"{m.name} is not among the outputs: with it (noise taken as {m.sd:.2g} {unit}".rstrip()
        + f") of the intervals {', '.join(parts)}; at the start values."
    )
    # What is known well already need not be known better.
    missed = bool(np.any((m.ratios < _DOUBT) & ~(m.before < _KNOWN)))
    severity = "doubt" if missed else "ok"
    return Finding("excitation.missing-output", severity, words, least, criterion)


def look_at_missing(
    problem: Problem, at: Solution
) -> tuple[tuple[str, ...], list[MissingOutput]] | None:
    """The parameters of interest, and for each output that no flight has what it would do; None
    where the method's rows are not samples of one output each.

    Args:
        problem: what is free.
        at: layout, data, noise and unknowns at the start values.
    """
    # The rows of a filter's predictions belong to all outputs together, which say each other's.
    if not at.layout.estimator.rows_are_samples:
        return None
    have = {n for names in at.layout.outputs for n in names}
    lacking = [n for n in naming.names(problem.model.Outputs) if n not in have]
    if not lacking:
        return at.layout.of_interest, []
    layout, data, z = _extended(problem, at, lacking)
    # Of noise one here: rows are divided by the right one once the simulation shows it.
    noise = at.noise._replace(sd=tuple({**sd, **dict.fromkeys(lacking, 1.0)} for sd in at.noise.sd))
    noise = jax.tree.map(lambda v: np.asarray(v, z.dtype), noise)
    evaluation = evaluate(layout, data, noise, z)
    sds = _noises(problem, at, evaluation.simulated, lacking)
    if not sds:
        return at.layout.of_interest, []
    s = _weighed(sensitivity_at(problem, layout, evaluation), layout, data, evaluation, sds)
    return at.layout.of_interest, _ratios(layout, data, s, lacking, sds)


def _extended(problem: Problem, at: Solution, lacking: list[str]) -> tuple[Layout, Data, jax.Array]:
    """Layout, data and unknowns with further outputs, of which nothing is measured yet."""
    flights, parts, z = [], [], [at.z[: at.layout.first_nuisance]]
    position = at.layout.first_nuisance
    for i, (flight, numbers) in enumerate(zip(problem.training, at.data.flights, strict=True)):
        zeros = np.zeros(flight.n_samples)
        outputs = {**flight.outputs, **dict.fromkeys(lacking, zeros)}
        flights.append(replace(flight, outputs=outputs))
        one = jnp.ones((), at.z.dtype)
        measured = {**numbers.outputs, **{n: jnp.asarray(zeros, at.z.dtype) for n in lacking}}
        scales = {**numbers.bias_scale, **dict.fromkeys(lacking, one)}
        parts.append(
            numbers._replace(
                outputs=dict(sorted(measured.items())),
                bias_scale=dict(sorted(scales.items())),
            )
        )
        states = at.layout.windows[i][0] * len(at.layout.states)
        size = states + at.layout.constants(at.layout.outputs[i])
        own = at.z[position : position + size]
        more = jnp.zeros(len(lacking) if at.layout.bias else 0, at.z.dtype)
        # Biases are zero at the start values, so that only their number counts.
        z += [own[:states], more, own[states:]]
        position += size
    layout = layout_of(problem, tuple(flights))
    return layout, at.data._replace(flights=tuple(parts)), jnp.concatenate(z)


def _noises(
    problem: Problem,
    at: Solution,
    simulated: tuple[dict[str, np.ndarray], ...],
    lacking: list[str],
) -> dict[str, float]:
    """The noise that each missing output is taken to have; none of what stands still."""
    record, by_unit = problem.model.Outputs, {}
    for sd in at.noise.sd:
        for n, size in sd.items():
            by_unit.setdefault(naming.unit(record, n), []).append(float(size))
    sds = {}
    for n in lacking:
        unit = naming.unit(record, n)
        moves = any(np.std(run[n]) > 0 for run in simulated)
        # A gyro has one noise in all its axes; of a unit that nothing measures yet that of small
        # autopilots' sensors, and of any other it is not known what it would be measured with.
        sd = float(np.median(by_unit[unit])) if unit in by_unit else TYPICAL.get(unit or "")
        if sd is not None and moves:
            sds[n] = sd
    return sds


def _weighed(
    s: Sensitivity, layout: Layout, data: Data, e: Evaluation, sds: dict[str, float]
) -> Sensitivity:
    """The rows of further outputs over their noise, their biases in sds of weak priors."""
    shared, own = s.shared.copy(), s.own.copy()
    numbers = signal_numbers(layout, data)
    for k, (_, name) in enumerate(signals(layout)):
        if name in sds:
            rows = np.flatnonzero(numbers == k)
            shared[rows] /= sds[name]
            own[rows] /= sds[name]
    column = 0
    for i, names in enumerate(layout.outputs):
        column += layout.windows[i][0] * len(layout.states)
        for j, name in enumerate(names):
            if layout.bias and name in sds:
                # Ten times the signal, as of the outputs that are measured.
                own[:, column + j] *= 10.0 * float(np.sqrt(np.mean(e.simulated[i][name] ** 2)))
        column += layout.constants(names)
    return Sensitivity(s.unknowns, shared, own)


def _ratios(
    layout: Layout, data: Data, s: Sensitivity, lacking: list[str], sds: dict[str, float]
) -> list[MissingOutput]:
    numbers, named = signal_numbers(layout, data), [n for _, n in signals(layout)]
    # What follows the samples are the defects between windows, which belong to every choice.
    output = np.concatenate([np.array(named)[numbers], np.full(len(s.shared) - numbers.size, "")])
    have = ~np.isin(output, lacking)
    before = expected_sd(s.unknowns, triangle(s, np.flatnonzero(have)))
    results = []
    for name, sd in sds.items():
        after = expected_sd(s.unknowns, triangle(s, np.flatnonzero(have | (output == name))))
        # What nothing determines before and after is as it was; what only the further output
        # determines is infinitely better.
        ratio = np.where(np.isfinite(after), 0.0, 1.0)
        both = np.isfinite(before) & np.isfinite(after) & (before > 0)
        np.divide(after, before, out=ratio, where=both)
        results.append(MissingOutput(name, sd, ratio, before))
    return results
