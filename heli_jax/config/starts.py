"""The starts of a configuration's free parameters, where its `fit.start` has them found."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from heli_jax import naming
from heli_jax.config.experiment import Experiment
from heli_jax.config.schema import FitConfig, LinearConfig
from heli_jax.errors import InputError, nearest
from heli_jax.flights.flight import Flight
from heli_jax.identification.free import Free
from heli_jax.identification.methods import METHODS, estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.linear_models.read import is_shipped

if TYPE_CHECKING:
    from heli_jax.identification.equation_error.first_guess import EquationErrorStart


def first_guesses(
    experiment: Experiment, flights: Sequence[Flight], free: Mapping[str, Free]
) -> "tuple[dict[str, Free], EquationErrorStart | None]":
    """The free parameters with their starts, and how these were found; None where they are given.

    Args:
        experiment: whose model is regressed without a disturbance, which needs no start here.
        flights: read.
        free: as the configuration has them; NaN where a start is left out.

    Raises:
        InputError: a start is missing, or none can be found.
    """
    config, path = experiment.config.fit, experiment.path
    assert config is not None
    # Before its start is asked for: of what the model does not have there is none.
    known = naming.names(experiment.model.Params)
    for name, f in free.items():
        if name not in known and (config.start.method == "equation-error" or math.isnan(f.start)):
            raise InputError(
                f"{path}: fit.free: model {experiment.model.name} has no parameter {name!r}"
                f"{nearest(name, known)}"
            )
    # NaN stands for a start that was left out, and no optimiser gets anywhere from it.
    # In frequency a fit begins where it is told to; what it finds takes the place of that later.
    if config.start.method != "equation-error":
        free = _from_vehicle(experiment, free)
        missing = [n for n, f in free.items() if math.isnan(f.start)]
        if missing:
            raise InputError(
                f"{path}: fit.free.{missing[0]}.start: missing, expected a number to begin with"
                f"{_shipped_value(experiment, missing[0])}, a value in the vehicle file or the "
                "model's own, or fit.start: equation-error, which finds one for linear models"
            )
        return dict(free), None
    # Not before it is needed: it takes a second to import.
    from heli_jax.identification.equation_error.start import equation_error_start

    # Without stepwise selection every term stays in: to leave one out is a change of the model,
    # which has to be asked for.
    limits = (config.start.f_enter, config.start.f_remove) if config.start.stepwise else None
    try:
        guess = equation_error_start(
            experiment.model, experiment.vehicle.params, flights, free, stepwise=limits
        )
    except ValueError as e:
        raise experiment.wrong("fit", e) from e
    # A start and nothing more: noise and gusts bias a regression, so that bounds and priors stay as
    # they were stated.
    return {n: f._replace(start=guess.values[n].value) for n, f in free.items()}, guess


def _shipped_value(experiment: Experiment, name: str) -> str:
    """What a linear model that ships has of a parameter, in SI; nothing of other models."""
    model = experiment.config.model
    if not (isinstance(model, LinearConfig) and is_shipped(model.linear)):
        return ""
    value = float(getattr(experiment.vehicle.params, name))
    return f" ({value:.4g} is that of the machine that the model was taken from)"


def _from_vehicle(experiment: Experiment, free: Mapping[str, Free]) -> Mapping[str, Free]:
    """Starts that are left out, from the vehicle file."""
    # The numbers of a linear model that ships are those of some other machine.
    model = experiment.config.model
    if isinstance(model, LinearConfig) and is_shipped(model.linear):
        return free
    stated = experiment.vehicle.constants
    return {
        n: f._replace(start=stated[n].value) if math.isnan(f.start) and n in stated else f
        for n, f in free.items()
    }


def instrument_for(config: FitConfig, method: str) -> tuple[str, ...] | None:
    """The inputs that a method takes by their instrument, as `Problem.instrument` has them.

    Args:
        config: whose `instrument` may be meant for the start, or for a method of `also`.
        method: that the problem is for.
    """
    others = [m for m in (config.start.method, *config.also) if m in METHODS]
    if estimator_of(method).by_instrument or not any(estimator_of(m).by_instrument for m in others):
        return config.by_instrument
    return None


def started_in_frequency(experiment: Experiment, problem: Problem) -> Problem:
    """The problem with the starts that `fit.start: frequency-error` finds; else as it is.

    Args:
        experiment: whose model is fitted in frequency without a disturbance.
        problem: to be fitted in time.

    Raises:
        InputError: frequency error cannot solve it.
    """
    config = experiment.config.fit
    if config is None or config.start.method != "frequency-error":
        return problem
    # Not before it is needed: it imports the optimiser, which takes a second.
    from heli_jax.identification.frequency_start import frequency_error_start, started

    known = naming.names(experiment.model.Params)
    bare = {
        "model": experiment.model,
        "vehicle": experiment.vehicle.params,
        "free": {n: f for n, f in problem.free.items() if n in known},
        "method": "frequency-error",
        "instrument": config.by_instrument,
    }
    whole = {"fixed_noise": (), "window": None, "continuity": None}
    try:
        base = replace(problem, **bare, **whole)
        guess = frequency_error_start(base, max_steps=config.max_steps)
    except ValueError as e:
        raise experiment.wrong("fit.start", e) from e
    return started(problem, guess)
