"""The problem that a configuration describes."""

import dataclasses
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from heli_jax import naming, units
from heli_jax.analysis.response_options import PairOptions, ResponseOptions
from heli_jax.config.experiment import Experiment
from heli_jax.config.kinematics import free_noise, sharpened, substeps_of
from heli_jax.config.logs import first_signals, read_flights
from heli_jax.config.schema import FitConfig, FreeConfig
from heli_jax.config.starts import first_guesses, instrument_for, started_in_frequency
from heli_jax.dynamics.disturbance import disturbable, with_disturbance
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest
from heli_jax.flights.flight import Flight
from heli_jax.flights.read import require_moving_outputs, require_some_time
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Free, Nuisance, Prior, Problem
from heli_jax.simulation.simulate import substeps_for

if TYPE_CHECKING:
    from heli_jax.identification.model_selection import Alternatives


def problem(experiment: Experiment) -> Problem:
    """The problem that a configuration's `fit` describes, its logs read.

    Raises:
        InputError: no fit or no flight, a log that cannot be read, or parts that do not fit.
    """
    config, path = experiment.config, experiment.path
    if config.fit is None:
        raise InputError(f"{path}: fit: missing, expected fit.free with a parameter to estimate")
    if not config.fit.free:
        raise InputError(f"{path}: fit.free: nothing is free, expected a parameter to estimate")
    # Before the logs are read, which may take minutes.
    _check_intervals(config.fit, path)
    nuisance = _nuisance(config.fit)
    flights = read_flights(experiment, gain=nuisance.input_gain)
    for flight in flights:
        if not flight.hold_out:  # which is simulated, and not fitted
            require_some_time(flight)
            require_moving_outputs(flight)
    free = {name: _free(f) for name, f in config.fit.free.items()}
    free, guess = first_guesses(experiment, flights, free)
    # Output error gets the bare model, whatever `disturbance` says: that section is then for
    # simulation and for the candidate models alone.
    model, params, fixed = experiment.model, experiment.vehicle.params, ()
    if config.fit.method == "filter-error":
        _require_disturbance(experiment, "fit.method")
        model, params = disturbed(experiment)
        free = {**free_noise(model, params, flights), **free}
        fixed = () if config.disturbance is None else tuple(config.disturbance.fixed)
    try:
        whole = Problem(
            model,
            params,
            # Not before the noise of the inputs is known, which it makes larger.
            tuple(sharpened(model, f) for f in flights),
            free,
            nuisance,
            # One number for all flights, since they share one compiled program: the slowest log's.
            substeps=_substeps(model, flights),
            gain_units=_gain_units(experiment) if nuisance.input_gain else {},
            method=config.fit.method,
            fixed_noise=fixed,
            window=None if config.fit.shooting is None else config.fit.shooting.window,
            continuity=None if config.fit.shooting is None else config.fit.shooting.continuity,
            first_guess=guess,
            instrument=instrument_for(config.fit, config.fit.method),
            frequency=_responses(experiment),
        )
        whole = with_chosen_windows(whole)
    except ValueError as e:
        raise experiment.wrong("fit", e) from e
    # Of the flights that are fitted: by now their windows are chosen.
    return started_in_frequency(experiment, whole)


def _require_disturbance(experiment: Experiment, place: str) -> None:
    # A model with process noise of its own needs none beside it.
    if experiment.config.disturbance is None and experiment.model.noise_intensity is None:
        raise InputError(
            f"{experiment.path}: {place}: filter-error needs a disturbance, expected "
            "disturbance: {axis: roll, poles: 1}"
        )


def by_other_methods(experiment: Experiment, fitted: Problem) -> dict[str, Problem | str]:
    """By method of `fit.also` the same problem for it, or why the method refuses it.

    Args:
        experiment: the configuration.
        fitted: the problem by its own method.

    Raises:
        InputError: filter error is asked for without a disturbance.
    """
    assert experiment.config.fit is not None
    if "filter-error" in experiment.config.fit.also:
        _require_disturbance(experiment, "fit.also")
    problems: dict[str, Problem | str] = {}
    for method in experiment.config.fit.also:
        try:
            problems[method] = by_method(experiment, fitted, method)
        except ValueError as e:
            problems[method] = str(e)
    return problems


def by_method(experiment: Experiment, fitted: Problem, method: str) -> Problem:
    """The same problem for another method.

    Args:
        experiment: the configuration.
        fitted: the problem by its own method.
        method: the other one.

    Raises:
        ValueError: the method refuses it.
    """
    config = experiment.config
    assert config.fit is not None
    model, params, fixed = experiment.model, experiment.vehicle.params, ()
    free = {n: fitted.free[n] for n in config.fit.free}
    if method == "filter-error":
        model, params = disturbed(experiment)
        free = {**free_noise(model, params, fitted.flights), **free}
        fixed = () if config.disturbance is None else tuple(config.disturbance.fixed)
    shooting = config.fit.shooting if estimator_of(method).windows else None
    return dataclasses.replace(
        fitted,
        model=model,
        vehicle=params,
        free=free,
        method=method,
        fixed_noise=fixed,
        window=None if shooting is None else shooting.window,
        continuity=None if shooting is None else shooting.continuity,
        instrument=instrument_for(config.fit, method),
    )


def _responses(experiment: Experiment) -> ResponseOptions:
    """Which frequency responses are fitted, where the method fits any."""
    config, method = experiment.config.frequency, experiment.config.fit
    if method is not None and not estimator_of(method.method).fits_responses:
        for key in ("pairs", "coherence"):
            # `heli-jax frf` shows all responses: where nothing is fitted to them it has no effect.
            if config is not None and getattr(config, key):
                raise InputError(
                    f"{experiment.path}: frequency.{key}: is for fit.method: frequency-response, "
                    f"got {method.method}"
                )
        # Nothing is fitted within it, which the fit says.
        return ResponseOptions(band=None if config is None else config.band)
    if config is None:
        return ResponseOptions()
    pairs = tuple(PairOptions(**dict(p)) for p in config.pairs or ())
    return ResponseOptions(config.band, config.window, config.points, config.coherence, pairs)


def with_chosen_windows(problem: Problem) -> Problem:
    """The problem with each flight of `window: auto` in its most telling windows.

    Raises:
        ValueError: no window of such a flight may be used.
    """
    chosen = tuple(f for f in problem.flights if f.choose_windows)
    if not chosen:
        return problem
    # Not before it is needed: it imports the optimiser, which takes a second.
    from heli_jax.identification.fit import windows
    from heli_jax.identification.validation.record_windows import window_flights

    # By what these flights say alone: the others are fitted whatever they say.
    asked = dataclasses.replace(problem, flights=chosen)
    parts = window_flights(asked, windows(asked))
    by_flight = {id(f): parts.get(i, ()) for i, f in enumerate(chosen)}
    flights = [part for f in problem.flights for part in by_flight.get(id(f), (f,))]
    return dataclasses.replace(problem, flights=tuple(flights))


def _substeps(model: Model, flights: Sequence[Flight]) -> int:
    if is_kinematic(model):
        return substeps_of(model, flights)
    return max(substeps_for(f.dt, model.fastest) for f in flights)


def _nuisance(config: FitConfig) -> Nuisance:
    stated = config.nuisance.model_dump()
    if isinstance(stated["input_offset"], list):  # YAML has no tuples
        stated["input_offset"] = tuple(stated["input_offset"])
    return Nuisance(**stated)


def _free(config: FreeConfig) -> Free:
    # By name: a field that Free has and the configuration lacks, or the reverse, is an error here.
    prior = None if config.prior is None else Prior(**dict(config.prior))
    return Free(**{**dict(config), "prior": prior})


def _check_intervals(config: FitConfig, path: Path) -> None:
    """Refuse before the fit what could not be done after it."""
    for name in config.intervals.profile:
        if name not in config.free:
            raise InputError(
                f"{path}: fit.intervals.profile: {name!r} is not free{nearest(name, config.free)}"
            )
    # Asked of the installation, not by an import, which takes seconds.
    for package in ("blackjax", "h5netcdf"):  # that samples, and that keeps the draws
        if config.intervals.nuts and importlib.util.find_spec(package) is None:
            raise InputError(
                f"{path}: fit.intervals.nuts: {package} is not installed, expected the extra "
                "bayes: pip install 'heli_jax[bayes]'"
            )
    in_frequency = estimator_of(config.method).noise_spectrum
    if config.intervals.bootstrap and config.nuisance.time_shift and not in_frequency:
        raise InputError(
            f"{path}: fit.intervals.bootstrap: not available with nuisance.time_shift, expected "
            "one of the two"
        )


def candidate_models(experiment: Experiment, fitted: Problem) -> "Alternatives":
    """The models that a configuration's `compare` puts beside the fitted one.

    Raises:
        InputError: no axis of the model can be disturbed.
    """
    # Not before it is needed: it imports the optimiser, which takes a second.
    from heli_jax.identification.disturbed_sets import disturbed_sets, undisturbed_too
    from heli_jax.identification.model_selection import alternatives

    model, disturbance = experiment.model, experiment.config.disturbance
    axes = disturbable(model)
    if not axes and disturbance is None:
        raise InputError(
            f"{experiment.path}: fit.compare: model {model.name} has no axis to disturb, expected "
            "one with roll, pitch or yaw, or disturbance: {on: [STATE]}"
        )
    stated = disturbance.names if disturbance is not None else ()
    # A list names some of what may be disturbed, and the other axes are in question as well; the
    # one of `axis: roll` is settled, and its poles are.
    asked = (
        stated if disturbance is not None and disturbance.axis else undisturbed_too(model, stated)
    )
    if len(asked) > 1:
        try:
            return disturbed_sets(fitted, model, asked, stated)
        except ValueError as e:
            raise InputError(f"{experiment.path}: disturbance: {e}") from e
    axis = next(iter(asked))
    # Whether there is a stand is in question only where its stiffness is.
    bare = model.without_stand if "kappa" in fitted.free else None
    return alternatives(fitted, model, axis, without_stand=bare)


# Params are classes of each model, hence Any.
def disturbed(experiment: Experiment) -> tuple[Model, Any]:
    """The model with the configuration's disturbance, and its parameters.

    Raises:
        InputError: the model has no such axis or state.
    """
    model, params = experiment.model, experiment.vehicle.params
    disturbance = experiment.config.disturbance
    if disturbance is None:
        return model, params
    try:
        model = with_disturbance(model, disturbance.names, disturbance.poles)
    except ValueError as e:
        raise InputError(f"{experiment.path}: disturbance: {e}") from e
    # Left out, sigma_w stays 0 and tau_w 1 s: filter error then makes an initial guess of its own.
    extra = {n: jnp.asarray(v) for n, v in disturbance.parameters.items() if v is not None}
    return model, model.Params(**{**naming.asdict(params), **extra})


def _gain_units(experiment: Experiment) -> dict[str, str]:
    """The unit that each input's gain carries: 1 where the log's unit is of the right kind."""
    # Of the first flight, since a gain is shared by all.
    out = {}
    for name, signal in first_signals(experiment).inputs.items():
        si = naming.unit(experiment.model.Inputs, name)
        plain = signal.unit is not None and units.is_plain(signal.unit)
        out[name] = si if si and plain and not units.is_plain(si) else "1"
    return out
