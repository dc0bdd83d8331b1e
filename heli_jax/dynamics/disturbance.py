"""Disturbances as part of the model: random accelerations with a correlation time.

Sensor noise before an on-board low-pass is not white in the log, but it is white on the filter's
state.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from heli_jax import naming, units
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Disturbance, LowPass, Model, axes_of, plain
from heli_jax.naming import Record, Scalar


def disturbable(model: Model) -> list[str]:
    """Return the names of a model's axes that can be disturbed."""
    return [axis.name for axis in axes_of(model)]


@functools.cache
def disturbable_states(model: Model) -> tuple[str, ...]:
    """Return the states that can be disturbed: all except those of pure kinematics.

    Kinematics (phi' = p, z' = -w) do not depend on the air: the derivative is another state, or its
    negative. The rate of an axis can always be disturbed.
    """
    names = naming.names(model.State)
    nan = np.float64(np.nan)
    # Random numbers that no formula maps to one another by chance.
    values = np.random.default_rng(7).uniform(0.5, 1.5, len(names))
    state = dict(zip(names, (np.float64(v) for v in values), strict=True))
    params = plain(model.Params(**dict.fromkeys(naming.names(model.Params), nan)))
    inputs = model.Inputs(**dict.fromkeys(naming.names(model.Inputs), nan))
    # NaN propagates through every operation, so a finite result uses neither parameters nor inputs.
    # This alone is not kinematics: v' = -0.4 v + 9.81 phi is a force with constant coefficients.
    with np.errstate(all="ignore"):
        rates = naming.asdict(model.vector_field(params, model.State(**state), inputs))
    turning = {axis.rate for axis in axes_of(model)}

    def bare(name: str) -> bool:
        size = abs(float(rates[name]))
        # The tolerance allows for evaluation in single precision.
        return any(n != name and abs(size - v) < 1e-6 for n, v in state.items())

    return tuple(n for n in names if n in turning or not bare(n))


def with_disturbance(model: Model, on: str | Sequence[str], poles: int = 1) -> Model:
    r"""Return the model with Ornstein-Uhlenbeck (Gauss-Markov) disturbances on some derivatives.

    $\dot w = -w/\tau_w + \sigma_w\sqrt{2/\tau_w}\,n$ with white noise n of unit intensity. w adds
    to the derivative of a state. It has standard deviation sigma_w (in that state's unit per
    second) and correlation time tau_w [s]. Two poles are two equal lags, scaled to the same
    sigma_w. w is stationary from the first sample, and with two poles the correlation of its states
    is 1/sqrt(2). Outputs equal to that derivative, such as an accelerometer's, include the
    disturbance.

    A single disturbance adds the parameters `sigma_w` (default 0) and `tau_w` (default 1 s).
    Several are named after the disturbed axis or state: `sigma_w_p`, `tau_w_p`. A model's own
    process noise stays unchanged.

    Args:
        on: names of disturbed axes (`disturbable`; w is an acceleration) or states
            (`disturbable_states`).
        poles: 1 or 2, the order of the noise filter.

    Raises:
        ValueError: the model has no such axis or state, it cannot be disturbed or is named twice,
            or `poles` is neither 1 nor 2.
    """
    on = (on,) if isinstance(on, str) else tuple(on)
    if model.within is not None:
        inner, around = model.within
        # An accelerometer measures the disturbance too, so it acts on the inner model. States that
        # only sensors' filters have are disturbed from outside.
        if set(on) <= {*disturbable(inner), *naming.names(inner.State)}:
            return _starting_as(model, around(_with_disturbances(inner, on, poles)))
    return _with_disturbances(model, on, poles)


@functools.cache
def _starting_as(model: Model, disturbed: Model) -> Model:
    """Return the disturbed model with the initial state of `model`, which may have been changed."""

    def start(p: Record) -> Record:
        return naming.replace(disturbed.initial_state(p), **naming.asdict(model.initial_state(p)))

    return dataclasses.replace(disturbed, start=start)


# Cached, since a model is static to jit and a second equal one would be compiled again.
@functools.cache
def _with_disturbances(model: Model, on: tuple[str, ...], poles: int) -> Model:
    check_model(model)
    if poles not in (1, 2):
        raise ValueError(f"poles must be 1 or 2, got {poles}")
    added = _disturbances(model, on, poles)
    Params, State = _records(model, added)
    disturbed = _Disturbed(model, added, State, _derivative_outputs(model, added))
    return Model(
        f"{model.name}-disturbed",
        disturbed.vector_field,
        disturbed.output,
        Params,
        State,
        model.Inputs,
        model.Outputs,
        linear=model.linear,
        start=disturbed.start,
        noise_intensity=disturbed.noise_intensity,
        initial_sd=disturbed.initial_sd,
        # With one pole each disturbance has one state, independent of the others, so it adds no
        # correlation to the model's own.
        correlation=disturbed.correlation if poles == 2 or model.correlation else None,
        limits=None if model.limits is None else disturbed.limits,
        axes=model.axes,
        body_rates=model.body_rates,
        # In a trim the disturbances are given as zero, as positions are.
        steady_flight=model.steady_flight,
        delays=model.delays,
        delay_lines=model.delay_lines,
        positive=model.positive,
        fastest=model.fastest,
        low_passes=model.low_passes,
        disturbances=(*model.disturbances, *added),
    )


def disturbances_of(model: Model) -> tuple[Disturbance, ...]:
    """Return the disturbances whose parameters filter error estimates."""
    if model.disturbances or model.noise_intensity is None:
        return model.disturbances
    # A user's model may define a disturbance by hand, with the names used here.
    if {"sigma_w", "tau_w"} <= set(naming.names(model.Params)):
        return (Disturbance("w", "", "sigma_w", "tau_w"),)
    return ()


def _disturbances(model: Model, on: tuple[str, ...], poles: int) -> tuple[Disturbance, ...]:
    """Return the disturbances to add, by name; raise ValueError if one is not possible."""
    if not on:
        raise ValueError("a disturbance needs an axis or a state to act on, got none")
    rates = {axis.name: axis.rate for axis in axes_of(model)}
    added: list[Disturbance] = []
    for name in on:
        state = rates.get(name, name)
        _check_pushed(model, name, state, rates)
        for other in (*model.disturbances, *added):
            if other.state == state:
                same = "twice" if other.name == name else f"by {other.name!r} as well"
                raise ValueError(f"{name!r} disturbs state {state!r}, which is disturbed {same}")
        # A single disturbance has the plain names, which `disturbances_of` also finds in a user's
        # model. Further ones need a suffix.
        ending = f"_{name}" if len(on) > 1 or model.disturbances else ""
        lags = tuple(f"w{i + 1}_{name}" for i in range(poles))
        added.append(Disturbance(name, state, f"sigma_w{ending}", f"tau_w{ending}", lags))
    # With equal names, the model's equations would read the disturbance instead of their own field.
    taken = {*naming.names(model.Params), *naming.names(model.State)}
    for d in added:
        for clash in sorted(taken & {d.sigma, d.tau, *d.lags}):
            raise ValueError(
                f"model {model.name} has {clash!r} already, a name that a disturbance on "
                f"{d.name!r} needs"
            )
    return tuple(added)


def _check_pushed(model: Model, name: str, state: str, rates: dict[str, str]) -> None:
    """Refuse a name that is neither an axis nor a state that can be disturbed."""
    allowed = disturbable_states(model)
    known = list(dict.fromkeys([*rates, *allowed]))
    expected = f"expected one of {', '.join(known)}" if known else "which has none to disturb"
    if state in allowed:
        return
    if state in naming.names(model.State):
        raise ValueError(
            f"model {model.name}: the derivative of {name!r} is kinematics, equal to another "
            f"state, so that no disturbance can act on it; {expected}"
        )
    raise ValueError(f"model {model.name} has no axis or state {name!r} to disturb, {expected}")


def _pushed_unit(model: Model, state: str) -> str:
    """Return the unit of a state's derivative; heave is not a rotation."""
    unit = naming.unit(model.State, state) or "rad/s"
    return f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"


def _derivative_outputs(
    model: Model, added: tuple[Disturbance, ...]
) -> tuple[tuple[str, str, float], ...]:
    """Return outputs that are plus or minus a disturbed derivative: name, disturbing lag, sign.

    They are found by two evaluations, as kinematics in `disturbable_states`. Units are compared
    too, since an output that is a state may have the same value.
    """
    pairs = [
        (d, name)
        for d in added
        for name in naming.names(model.Outputs)
        if _same_kind(naming.unit(model.Outputs, name), _pushed_unit(model, d.state))
    ]
    if not pairs:
        return ()
    rng = np.random.default_rng(8)
    at = [_at_random(model, rng) for _ in range(2)]
    # The tolerance allows for evaluation in single precision.
    return tuple(
        (name, d.lags[-1], sign)
        for d, name in pairs
        for sign in (1.0, -1.0)
        if all(abs(y[name] - sign * r[d.state]) < 1e-6 * abs(r[d.state]) for r, y in at)
    )


def _same_kind(unit: str | None, other: str) -> bool:
    if unit is None or not (units.is_unit(unit) and units.is_unit(other)):
        return False
    return units.base_of(unit) == units.base_of(other)


def _at_random(model: Model, rng: np.random.Generator) -> tuple[dict[str, float], dict[str, float]]:
    """Return a model's rates and outputs at random numbers that no formula maps to one another."""
    p, s, u = (
        record(**{n: np.float64(rng.uniform(0.5, 1.5)) for n in naming.names(record)})
        for record in (model.Params, model.State, model.Inputs)
    )
    p = plain(p)
    with np.errstate(all="ignore"):
        both = (model.vector_field(p, s, u), model.output(p, s, u))
    rates, outputs = ({n: float(v) for n, v in naming.asdict(one).items()} for one in both)
    return rates, outputs


def _records(model: Model, added: tuple[Disturbance, ...]) -> tuple[type, type]:
    """Return the classes of parameters and states, extended by the disturbances."""
    parameters, states = {}, {}
    for d in added:
        unit, of = _pushed_unit(model, d.state), f" on {d.name}" if len(added) > 1 else ""
        # A default of zero leaves the model undisturbed.
        parameters[d.sigma] = (
            Annotated[Scalar, unit, f"disturbance standard deviation{of}"],
            0.0,
        )
        parameters[d.tau] = (Annotated[Scalar, "s", f"disturbance correlation time{of}"], 1.0)
        acceleration = Annotated[Scalar, unit, f"disturbance acceleration{of}"]
        states |= dict.fromkeys(d.lags, (acceleration, None))
    return (
        naming.extended(model.Params, f"{model.Params.__name__}Disturbed", parameters),
        naming.extended(model.State, f"{model.State.__name__}Disturbed", states),
    )


class _Disturbed(NamedTuple):
    """Functions of a disturbed model, which wrap those of the original."""

    model: Model
    added: tuple[Disturbance, ...]
    State: type
    felt: tuple[tuple[str, str, float], ...]
    """Outputs that equal the derivative of a disturbed state: name, disturbing lag, sign."""

    def undisturbed(self, state: Record) -> Record:
        """Return the State of the original model."""
        states = naming.names(self.model.State)
        return self.model.State(**{n: getattr(state, n) for n in states})

    def vector_field(self, p: Record, s: Record, u: Record) -> Record:
        """Return the model's derivatives with disturbances added, and those of the disturbances."""
        # A gust's moment over inertia adds to the derivative. A disturbance of the angle would
        # jump, and one of the output would not act through the flybar.
        rates = naming.asdict(self.model.vector_field(p, self.undisturbed(s), u))
        for d in self.added:
            rates[d.state] = rates[d.state] + getattr(s, d.lags[-1])
            rates |= _filtered(d, p, s)
        return self.State(**rates)

    def output(self, p: Record, s: Record, u: Record) -> Record:
        """Return the model's outputs, with the disturbance on those that equal its derivative."""
        outputs = self.model.output(p, self.undisturbed(s), u)
        # Without the disturbance in an accelerometer's output, a gust would look like
        # autocorrelated noise, and the filter would estimate a wrong size and time.
        pushed = {
            name: getattr(outputs, name) + sign * getattr(s, lag) for name, lag, sign in self.felt
        }
        return naming.replace(outputs, **pushed) if pushed else outputs

    def limits(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the model's limits, by name."""
        assert self.model.limits is not None
        return self.model.limits(p, self.undisturbed(s), u)

    def noise_intensity(self, p: Record) -> Record:
        own = self.model.noise_intensity
        # Zeros computed from a parameter have its type and batch axis.
        zero = 0.0 * getattr(p, self.added[0].sigma)
        intensity = dict.fromkeys(naming.names(self.State), zero)
        intensity |= naming.asdict(own(p)) if own is not None else {}
        for d in self.added:
            # A first-order lag driven by q has the variance q^2 tau/2; q is chosen for sigma_w^2.
            intensity[d.lags[0]] = getattr(p, d.sigma) * (2.0 / getattr(p, d.tau)) ** 0.5
        return self.State(**intensity)

    def start(self, p: Record) -> Record:
        start = naming.asdict(self.model.initial_state(p))
        for d in self.added:
            start |= dict.fromkeys(d.lags, 0.0 * getattr(p, d.sigma))
        return self.State(**start)

    def initial_sd(self, p: Record) -> dict[str, Any]:
        own = self.model.initial_sd
        sds = dict(own(p)) if own is not None else {}
        for d in self.added:
            # Gusts exist before the record starts, so w has its stationary sd at the first sample.
            # Zero would make the first tau_w seconds calm, and a filter would trust them too much.
            sds |= dict.fromkeys(d.lags, getattr(p, d.sigma))
        return sds

    def correlation(self, p: Record) -> dict[tuple[str, str], Any]:
        own = self.model.correlation
        pairs = dict(own(p)) if own is not None else {}
        # Lyapunov equation of two equal lags: E[w1 w2] = gain/2 E[w1^2], for any tau_w.
        for d in self.added:
            if len(d.lags) == 2:
                pairs[d.lags[0], d.lags[1]] = 0.5 * _gain(d) + 0.0 * getattr(p, d.sigma)
        return pairs


def _gain(d: Disturbance) -> float:
    # The second equal lag halves the variance; the gain restores it.
    return 2.0**0.5 if len(d.lags) == 2 else 1.0


def _filtered(d: Disturbance, p: Record, s: Record) -> dict[str, Scalar]:
    """Return the derivatives of a disturbance's own states."""
    rates: dict[str, Scalar] = {}
    before: Scalar | None = None
    # White noise drives the first lag; it is in `noise_intensity`, not in the field. Each further
    # lag follows the previous one.
    for name in d.lags:
        w = getattr(s, name)
        pull = -w if before is None else _gain(d) * before - w
        # Both lags share one time constant, since a fit could not distinguish two.
        rates[name], before = pull / getattr(p, d.tau), w
    return rates


def sensor_noise(output: str) -> str:
    """Return the name of the parameter for the sd of an output's sensor noise, after
    the filters.
    """
    return f"sigma_n_{output}"


@functools.cache
def with_sensor_noise(model: Model, outputs: tuple[str, ...]) -> Model:
    """Return the model with white sensor noise before the low-passes of some outputs.

    Each adds a parameter `sigma_n_OUTPUT`, the standard deviation after the filters, in the
    output's unit. Noise that is white at the filter's input is process noise on the filter's state.

    Args:
        model: a model with `low_passes` for these outputs.
    """
    if not outputs:
        return model
    added = tuple(p for p in model.low_passes if p.output in outputs)
    more = {}
    for p in added:
        unit = naming.unit(model.Outputs, p.output) or "1"
        meaning = f"sd of the noise of {p.output} that passed its filters"
        more[sensor_noise(p.output)] = (Annotated[Scalar, unit, meaning], 0.0)
    noisy = _Noisy(model, added)
    return dataclasses.replace(
        model,
        Params=naming.extended(model.Params, f"{model.Params.__name__}SensorNoise", more),
        noise_intensity=noisy.noise_intensity,
    )


class _Noisy(NamedTuple):
    """A model with sensor noise in addition to its own process noise."""

    model: Model
    added: tuple[LowPass, ...]

    def noise_intensity(self, p: Record) -> Record:
        own = self.model.noise_intensity
        # Zeros computed from a parameter have its type and batch axis.
        zero = 0.0 * getattr(p, sensor_noise(self.added[0].output))
        intensity = dict.fromkeys(naming.names(self.model.State), zero)
        intensity |= naming.asdict(own(p)) if own is not None else {}
        for low_pass in self.added:
            sd = getattr(p, sensor_noise(low_pass.output))
            intensity[low_pass.state] = low_pass.intensity * sd
        return self.model.State(**intensity)
