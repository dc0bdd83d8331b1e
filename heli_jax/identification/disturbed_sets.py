"""Which axes are disturbed: candidate models with all of them, each left out, and none."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of, with_disturbance
from heli_jax.dynamics.model import Model, axes_of
from heli_jax.identification.model_selection import Alternatives, same_parameters
from heli_jax.identification.problem import Problem


def undisturbed_too(model: Model, names: Sequence[str]) -> tuple[str, ...]:
    """The named axes and states, then the model's other axes."""
    axes = axes_of(model)
    rates = {axis.name: axis.rate for axis in axes}
    pushed = {rates.get(n, n) for n in names}
    return (*names, *(axis.name for axis in axes if axis.rate not in pushed))


def disturbed_sets(
    problem: Problem, model: Model, names: Sequence[str], stated: Sequence[str] = ()
) -> Alternatives:
    """No disturbance, each one left out, all, and all with two poles; by filter error.

    As many candidates as disturbances and three: of four there would be sixteen sets, of six 64.

    Args:
        problem: gives vehicle, flights, free parameters and nuisances; what it says of disturbances
            (starts, what is fixed) holds for the candidates that have them.
        model: the model without disturbance.
        names: two and more axes or states that may be disturbed.
        stated: those of a configuration, which are a candidate of their own.

    Raises:
        ValueError: one of them cannot be disturbed, or there are fewer than two.
    """
    if len(names) < 2:
        raise ValueError(f"expected two disturbances or more to choose from, got {len(names)}")
    listed = ", ".join(names)
    # A model with one disturbance, not the model without: the same estimator, the same noise and so
    # a likelihood that can be set beside the others'.
    problems = {"no disturbance": _none(problem, with_disturbance(model, names[0]))}
    everything = f"all: {listed}"
    for name in names:
        rest = [n for n in names if n != name]
        disturbed = with_disturbance(model, rest)
        problems[f"without {name}: {', '.join(rest)}"] = _of(problem, disturbed)
    if 0 < len(stated) < len(names) - 1:
        only = f"only {', '.join(stated)}"
        problems[only] = _of(problem, with_disturbance(model, stated))
    # What is within all of them, with nothing of its own: only of such pairs does a likelihood
    # ratio have a known distribution.
    smaller = list(problems)[1:]
    problems[everything] = _of(problem, with_disturbance(model, names))
    two = f"{everything}; two poles"
    problems[two] = _of(problem, with_disturbance(model, names, 2))
    # Two poles are no extension of one: both have as many parameters, so the two are compared by
    # AIC and not by a test.
    nested = [("no disturbance", name) for name in (*smaller, everything, two)]
    nested += [(name, everything) for name in smaller]
    return Alternatives(problems, tuple(nested))


def _of(problem: Problem, disturbed: Model) -> Problem:
    """The problem by filter error with that model, its noise's starts where there are some."""
    vehicle, known = naming.asdict(problem.vehicle), _known(problem, disturbed)
    same = same_parameters(disturbed, problem.model)
    # Starts that were stated for a disturbance hold in every candidate that has it, whatever it is
    # called there: alone it has the plain names.
    known |= {n: vehicle[m] for n, m in same.items()}
    fixed = [n for n, m in same.items() if m in problem.fixed_noise]
    return replace(
        problem,
        model=disturbed,
        vehicle=disturbed.Params(**known),
        method="filter-error",
        instrument=None,
        fixed_noise=(*fixed, *(n for n in problem.fixed_noise if n == "sigma_y")),
    )


def _none(problem: Problem, disturbed: Model) -> Problem:
    """The problem by filter error with a model whose one disturbance is fixed at all but nothing:
    the measurement noise is then laid out as in the others, and the likelihoods can be compared."""
    [d] = disturbances_of(disturbed)
    known = _known(problem, disturbed)
    # Not zero: the logarithm of a size is what the layout holds. A billionth of the motion moves no
    # digit of the likelihood.
    known |= {d.sigma: jnp.asarray(1e-9 * problem.motion), d.tau: jnp.asarray(1.0)}
    kept = (n for n in problem.fixed_noise if n == "sigma_y")
    return replace(
        problem,
        model=disturbed,
        vehicle=disturbed.Params(**known),
        method="filter-error",
        instrument=None,
        fixed_noise=(d.sigma, d.tau, *kept),
    )


def _known(problem: Problem, disturbed: Model) -> dict[str, object]:
    """The vehicle's values of what that model has, without the disturbances' own."""
    vehicle = naming.asdict(problem.vehicle)
    own = {n for d in disturbances_of(disturbed) for n in (d.sigma, d.tau)}
    return {n: vehicle[n] for n in naming.names(disturbed.Params) if n in vehicle and n not in own}
