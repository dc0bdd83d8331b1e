"""Fit problem of a configuration."""

import dataclasses
import importlib.util
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from heli_jax import naming, units
from heli_jax.analysis.spectra import PairOptions, ResponseOptions
from heli_jax.config.experiment import Experiment
from heli_jax.config.kinematics import free_noise, sharpened, substeps_of
from heli_jax.config.logs import first_signals, read_flights
from heli_jax.config.schema import FitConfig, LinearConfig
from heli_jax.dynamics.disturbance import disturbable, with_disturbance
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, located, nearest, require_known
from heli_jax.flights.flight import Flight
from heli_jax.flights.read import require_moving_outputs, require_some_time
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Free, Nuisance, Prior, Problem
from heli_jax.linear_models.read import is_shipped
from heli_jax.simulation.simulate import substeps_for

if TYPE_CHECKING:
    from heli_jax.identification.equation_error.start import EquationErrorStart
    from heli_jax.identification.select import Alternatives


def problem(experiment: Experiment, planned: Sequence[Flight] = ()) -> Problem:
    """Return the problem of a configuration's `fit`, with its logs read.

    Args:
        planned: flights in place of the logs, for a design.

    Raises:
        InputError: no fit or no flight, a log that cannot be read, or parts that do not match.
    """
    config, path = experiment.config, experiment.path
    if config.fit is None:
        raise InputError(f"{path}: fit: missing, expected fit.free with a parameter to estimate")
    if not config.fit.free:
        raise InputError(f"{path}: fit.free: nothing is free, expected a parameter to estimate")
    # Before the logs are read, which may take minutes.
    _check_intervals(config.fit, path)
    nuisance = _nuisance(config.fit)
    flights = planned or read_flights(experiment, gain=nuisance.input_gain)
    for flight in flights:
        if not (flight.hold_out or planned):  # a hold-out flight is simulated, not fitted
            require_some_time(flight)
            require_moving_outputs(flight)
    # By name: a field that only Free or only the configuration has is an error here.
    free = {
        name: Free(**{**dict(f), "prior": None if f.prior is None else Prior(**dict(f.prior))})
        for name, f in config.fit.free.items()
    }
    free, guess = _first_guesses(experiment, flights, free)
    if objective_of(config.fit.method).noise_model == "disturbance":
        _require_disturbance(experiment, "fit.method")
    of_method = _of_method(experiment, config.fit.method, flights, free)
    model = of_method["model"]
    # One number for all flights, because they share a compiled program: that of the slowest log.
    substeps = max(substeps_for(f.dt, model.fastest) for f in flights)
    with experiment.located("fit"):
        whole = Problem(
            **of_method,
            # Sharpening increases the noise of the inputs, so it waits until that is known.
            flights=tuple(sharpened(model, f) for f in flights),
            nuisance=nuisance,
            substeps=substeps_of(model, flights) if is_kinematic(model) else substeps,
            gain_units=_gain_units(experiment) if nuisance.input_gain else {},
            first_guess=guess,
            frequency=_responses(experiment),
        )
        return with_chosen_windows(whole)


def _require_disturbance(experiment: Experiment, place: str) -> None:
    # A model with process noise of its own needs no disturbance.
    if experiment.config.disturbance is None and experiment.model.noise_intensity is None:
        raise InputError(
            f"{experiment.path}: {place}: filter-error needs a disturbance, expected "
            "disturbance: {axis: roll, poles: 1}"
        )


def by_other_methods(experiment: Experiment, fitted: Problem) -> dict[str, Problem | str]:
    """Return the same problem for each method of `fit.also`, or why the method refuses it.

    Raises:
        InputError: filter error is requested without a disturbance.
    """
    assert experiment.config.fit is not None
    also = map(objective_of, experiment.config.fit.also)
    if any(objective.noise_model == "disturbance" for objective in also):
        _require_disturbance(experiment, "fit.also")
    problems: dict[str, Problem | str] = {}
    for method in experiment.config.fit.also:
        try:
            problems[method] = by_method(experiment, fitted, method)
        except ValueError as e:
            problems[method] = str(e)
    return problems


def by_method(experiment: Experiment, fitted: Problem, method: str) -> Problem:
    """Return the same problem for another method.

    Raises:
        ValueError: the method refuses it.
    """
    assert experiment.config.fit is not None
    free = {n: fitted.free[n] for n in experiment.config.fit.free}
    return dataclasses.replace(fitted, **_of_method(experiment, method, fitted.flights, free))


# Any: fields of a `Problem`.
def _of_method(
    experiment: Experiment, method: str, flights: Sequence[Flight], free: dict[str, Free]
) -> dict[str, Any]:
    """Return the parts of a problem that depend on its method."""
    config = experiment.config
    assert config.fit is not None
    # Output error gets the bare model, whatever `disturbance` states. The section then serves only
    # simulation and the candidate models.
    model, params, fixed = experiment.model, experiment.vehicle.params, ()
    if objective_of(method).noise_model == "disturbance":
        model, params = disturbed(experiment)
        free = {**free_noise(model, params, flights), **free}
        fixed = () if config.disturbance is None else tuple(config.disturbance.fixed)
    # If windows are requested but the method has none, the fit itself reports it.
    requested = method == config.fit.method or objective_of(method).noise_model == "white"
    shooting = config.fit.shooting if requested else None
    return {
        "model": model,
        "vehicle": params,
        "free": free,
        "method": method,
        "fixed_noise": fixed,
        "window": None if shooting is None else shooting.window,
        "continuity": None if shooting is None else shooting.continuity,
        "instrument": _instrument_for(config.fit, method),
    }


def _responses(experiment: Experiment) -> ResponseOptions:
    """Return the options of frequency responses, if the method fits any."""
    config, method = experiment.config.frequency, experiment.config.fit
    if method is not None and not objective_of(method.method).fits_responses:
        for key in ("pairs", "coherence"):
            # `heli-jax frf` shows all responses; without a fit to them the key has no effect.
            if config is not None and getattr(config, key):
                raise InputError(
                    f"{experiment.path}: frequency.{key}: is for fit.method: frequency-response, "
                    f"got {method.method}"
                )
        # The band is not used by the fit, which reports it.
        return ResponseOptions(band=None if config is None else config.band)
    if config is None:
        return ResponseOptions()
    pairs = tuple(PairOptions(**dict(p)) for p in config.pairs or ())
    return ResponseOptions(config.band, config.window, config.points, config.coherence, pairs)


def with_chosen_windows(problem: Problem) -> Problem:
    """Return the problem with each flight of `window: auto` in its most informative windows.

    Raises:
        ValueError: no window of such a flight can be used.
    """
    chosen = tuple(f for f in problem.flights if f.choose_windows)
    if not chosen:
        return problem
    # Imported on demand: the optimiser takes a second to import.
    from heli_jax.identification.design.windows import window_flights
    from heli_jax.identification.fit import windows

    # Only these flights' information counts: the others are fitted in any case.
    requested = dataclasses.replace(problem, flights=chosen)
    parts = window_flights(requested, windows(requested))
    by_flight = {id(f): parts.get(i, ()) for i, f in enumerate(chosen)}
    flights = [part for f in problem.flights for part in by_flight.get(id(f), (f,))]
    return dataclasses.replace(problem, flights=tuple(flights))


def _nuisance(config: FitConfig) -> Nuisance:
    stated = config.nuisance.model_dump()
    if isinstance(stated["input_offset"], list):  # YAML has no tuples
        stated["input_offset"] = tuple(stated["input_offset"])
    return Nuisance(**stated)


def _check_intervals(config: FitConfig, path: Path) -> None:
    """Refuse before the fit what cannot be done after it."""
    for name in config.intervals.profile:
        if name not in config.free:
            raise InputError(
                f"{path}: fit.intervals.profile: {name!r} is not free{nearest(name, config.free)}"
            )
    # Without an import, which takes seconds.
    for package in ("blackjax", "h5netcdf"):  # the sampler, and the format of its draws
        if config.intervals.nuts and importlib.util.find_spec(package) is None:
            raise InputError(
                f"{path}: fit.intervals.nuts: {package} is not installed, expected the extra "
                "bayes: pip install 'heli_jax[bayes]'"
            )
    objective = objective_of(config.method)
    if config.intervals.bootstrap and objective.fits_responses:
        raise InputError(
            f"{path}: fit.intervals.bootstrap: not available with method {config.method}, expected "
            "another method or fit.intervals.profile"
        )
    in_frequency = objective.noise_model == "spectrum"
    if config.intervals.bootstrap and config.nuisance.time_shift and not in_frequency:
        raise InputError(
            f"{path}: remove fit.intervals.bootstrap or fit.nuisance.time_shift: the bootstrap "
            "does not estimate the time shift"
        )


def candidate_models(experiment: Experiment, fitted: Problem) -> "Alternatives":
    """Return the models that `compare` fits besides the configured one.

    Raises:
        InputError: no axis of the model can be disturbed.
    """
    # Not before it is needed: it imports the optimiser, which takes a second.
    from heli_jax.identification.select import alternatives, other_axes

    model, disturbance = experiment.model, experiment.config.disturbance
    axes = disturbable(model)
    if not axes and disturbance is None:
        raise InputError(
            f"{experiment.path}: fit.compare: model {model.name} has no axis to disturb, expected "
            "one with roll, pitch or yaw, or disturbance: {on: [STATE]}"
        )
    stated = disturbance.names if disturbance is not None else ()
    # With a list, the other axes are candidates as well. With `axis: roll` the axis is fixed and
    # only its poles are compared.
    requested = (
        stated if disturbance is not None and disturbance.axis else other_axes(model, stated)
    )
    with located(f"{experiment.path}: disturbance"):
        return alternatives(fitted, model, requested, stated=stated)


# Params are classes of each model, hence Any.
def disturbed(experiment: Experiment) -> tuple[Model, Any]:
    """Return the model with the configuration's disturbance, and its parameters.

    Raises:
        InputError: the model has no such axis or state.
    """
    model, params = experiment.model, experiment.vehicle.params
    disturbance = experiment.config.disturbance
    if disturbance is None:
        return model, params
    with located(f"{experiment.path}: disturbance"):
        model = with_disturbance(model, disturbance.names, disturbance.poles)
    # By default sigma_w stays 0 and tau_w 1 s; filter error then makes its own initial guess.
    extra = {n: jnp.asarray(v) for n, v in disturbance.parameters.items() if v is not None}
    return model, model.Params(**{**naming.asdict(params), **extra})


def _gain_units(experiment: Experiment) -> dict[str, str]:
    """Return the unit of each input's gain: 1 if the log's unit is of the right kind."""
    # The first flight serves for all, because flights share the gains.
    out = {}
    for name, signal in first_signals(experiment).inputs.items():
        si = naming.unit(experiment.model.Inputs, name)
        plain = signal.unit is not None and units.is_plain(signal.unit)
        out[name] = si if si and plain and not units.is_plain(si) else "1"
    return out


def _first_guesses(
    experiment: Experiment, flights: Sequence[Flight], free: Mapping[str, Free]
) -> "tuple[dict[str, Free], EquationErrorStart | None]":
    """Return the free parameters with their starts, and the equation-error result or None.

    Args:
        free: free parameters of the configuration; NaN where a start is left out.
    """
    config, path = experiment.config.fit, experiment.path
    assert config is not None
    # Before the search: a parameter that the model lacks has no start.
    known = naming.names(experiment.model.Params)
    found = config.start == "equation-error"
    requested = [n for n, f in free.items() if found or math.isnan(f.start)]
    words = f"model {experiment.model.name} has no parameter"
    require_known(requested, known, f"{path}: fit.free", words)
    # NaN means that a start was left out; no optimiser can use it.
    if config.start != "equation-error":
        free = _from_vehicle(experiment, free)
        missing = [n for n, f in free.items() if math.isnan(f.start)]
        if missing:
            raise InputError(
                f"{path}: fit.free.{missing[0]}.start: missing, expected a number to begin with"
                f"{_shipped_value(experiment, missing[0])}, a value in the vehicle file or the "
                "model's own, or fit.start: equation-error, which finds one for linear models"
            )
        return dict(free), None
    # Imported on demand: it takes a second.
    from heli_jax.identification.equation_error.start import equation_error_start

    with experiment.located("fit"):
        guess = equation_error_start(experiment.model, experiment.vehicle.params, flights, free)
    # Only the start is used: noise and gusts bias a regression, so bounds and priors stay as
    # stated.
    return {n: f._replace(start=guess.values[n].value) for n, f in free.items()}, guess


def _shipped_value(experiment: Experiment, name: str) -> str:
    """Return a parameter's value in a shipped linear model, in SI; empty for other models."""
    model = experiment.config.model
    if not (isinstance(model, LinearConfig) and is_shipped(model.linear)):
        return ""
    value = float(getattr(experiment.vehicle.params, name))
    return f" ({value:.4g} is the value of the vehicle for which the model was published)"


def _from_vehicle(experiment: Experiment, free: Mapping[str, Free]) -> Mapping[str, Free]:
    """Fill in missing starts from the vehicle file."""
    # The values of a shipped linear model belong to another vehicle.
    model = experiment.config.model
    if isinstance(model, LinearConfig) and is_shipped(model.linear):
        return free
    stated = experiment.vehicle.constants
    return {
        n: f._replace(start=stated[n].value) if math.isnan(f.start) and n in stated else f
        for n, f in free.items()
    }


def _instrument_for(config: FitConfig, method: str) -> tuple[str, ...] | None:
    """Return the inputs that a method uses by their instrument, as in `Problem.instrument`.

    Args:
        config: section whose `instrument` may apply only to a method of `also`.
    """
    if objective_of(method).noise_model == "spectrum" or not any(
        objective_of(m).noise_model == "spectrum" for m in config.also
    ):
        return config.by_instrument
    return None
