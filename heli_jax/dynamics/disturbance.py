"""Disturbances as part of the model: random pushes on derivatives, each with a memory.

Noise of sensors before an on-board low-pass is not white in the log, but white on its state.
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
    """The axes of a model that can be disturbed, by name."""
    return [axis.name for axis in axes_of(model)]


@functools.cache
def disturbable_states(model: Model) -> tuple[str, ...]:
    """The states whose derivative may be pushed: all but those of pure kinematics.

    Kinematics (phi' = p, z' = -w) hold whatever the air does: the derivative is another state, or
    its negative, and nothing else. The rate of an axis may always be pushed.
    """
    names = naming.names(model.State)
    nan = np.float64(np.nan)
    # Numbers that no formula makes of one another by chance.
    values = np.random.default_rng(7).uniform(0.5, 1.5, len(names))
    state = dict(zip(names, (np.float64(v) for v in values), strict=True))
    params = plain(model.Params(**dict.fromkeys(naming.names(model.Params), nan)))
    inputs = model.Inputs(**dict.fromkeys(naming.names(model.Inputs), nan))
    # NaN goes through every operation that uses it: what is still a number uses neither. That alone
    # does not make it kinematics: v' = -0.4 v + 9.81 phi is a force whose coefficients are written
    # as numbers.
    with np.errstate(all="ignore"):
        rates = naming.asdict(model.vector_field(params, model.State(**state), inputs))
    turning = {axis.rate for axis in axes_of(model)}

    def bare(name: str) -> bool:
        size = abs(float(rates[name]))
        # To single precision, in which the model may have been evaluated.
        return any(n != name and abs(size - v) < 1e-6 for n, v in state.items())

    return tuple(n for n in names if n in turning or not bare(n))


def with_disturbance(model: Model, on: str | Sequence[str], poles: int = 1) -> Model:
    r"""The model with an Ornstein-Uhlenbeck (Gauss-Markov) push on one or several derivatives.

    $\dot w = -w/\tau_w + \sigma_w\sqrt{2/\tau_w}\,n$ with white noise n of unit intensity, so that
    w, which adds to the derivative of a state, has the standard deviation sigma_w (in that state's
    unit per second) and the correlation time tau_w [s]. With two poles w follows a second lag of
    the same time constant, scaled to the same standard deviation. At the first sample w is what it
    is at any other: all its states have the standard deviation sigma_w, and the two of two poles
    the correlation 1/sqrt(2). An output that is that derivative by its equation, or its negative
    (an acceleration as an accelerometer has it), has the push in it too.

    With one the model gains the parameters `sigma_w` (default 0) and `tau_w` (default 1 s); with
    several each has its own, named after what is disturbed: `sigma_w_p`, `tau_w_p`. A model's own
    process noise stays as it is.

    Args:
        on: what is disturbed: axes (`disturbable`: the push is an acceleration) or states
            (`disturbable_states`), by name.
        poles: 1 or 2, the order of the filter that colours the noise.

    Raises:
        ValueError: the model has no such axis or state, it cannot be pushed or is named twice, or
            `poles` is neither 1 nor 2.
    """
    on = (on,) if isinstance(on, str) else tuple(on)
    if model.within is not None:
        inner, around = model.within
        # An accelerometer feels the push too, so it is put on what the accelerometer is made of.
        # What only devices behind the sensors have (a low-pass) is pushed from outside.
        if set(on) <= {*disturbable(inner), *naming.names(inner.State)}:
            return _starting_as(model, around(_with_disturbances(inner, on, poles)))
    return _with_disturbances(model, on, poles)


@functools.cache
def _starting_as(model: Model, disturbed: Model) -> Model:
    """The disturbed model, begun where the model is: an initial state may have been set on it."""

    def start(p: Record) -> Record:
        return naming.replace(disturbed.initial_state(p), **naming.asdict(model.initial_state(p)))

    return dataclasses.replace(disturbed, start=start)


# Cached: a model is static to jit, and a second one of the same kind would be compiled again.
@functools.cache
def _with_disturbances(model: Model, on: tuple[str, ...], poles: int) -> Model:
    check_model(model)
    if poles not in (1, 2):
        raise ValueError(f"poles must be 1 or 2, got {poles}")
    added = _disturbances(model, on, poles)
    Params, State = _records(model, added)
    disturbed = _Disturbed(model, added, State, _felt(model, added))
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
        # With one pole each push has one state, and pushes do not depend on one another: there is
        # nothing to correlate that the model does not correlate itself.
        correlation=disturbed.correlation if poles == 2 or model.correlation else None,
        limits=None if model.limits is None else disturbed.limits,
        axes=model.axes,
        body_rates=model.body_rates,
        # The pushes are given in a trim, at zero, as positions are.
        steady_flight=model.steady_flight,
        delays=model.delays,
        delay_lines=model.delay_lines,
        positive=model.positive,
        fastest=model.fastest,
        low_passes=model.low_passes,
        disturbances=(*model.disturbances, *added),
    )


def disturbances_of(model: Model) -> tuple[Disturbance, ...]:
    """The disturbances whose parameters filter error estimates by itself."""
    if model.disturbances or model.noise_intensity is None:
        return model.disturbances
    # A model of one's own may have been given one by hand, under the names that it has here.
    if {"sigma_w", "tau_w"} <= set(naming.names(model.Params)):
        return (Disturbance("w", "", "sigma_w", "tau_w"),)
    return ()


def only_disturbed(model: Model) -> bool:
    """True if all process noise comes from disturbances and none is the model's own."""
    if model.noise_intensity is None:
        return True
    # With every sigma at zero what is left is the model's own, at any value of its parameters.
    params = dict.fromkeys(naming.names(model.Params), 1.0)
    params |= {d.sigma: 0.0 for d in disturbances_of(model)}
    own = naming.asdict(model.noise_intensity(model.Params(**params)))
    return all(float(v) == 0.0 for v in own.values())


def _disturbances(model: Model, on: tuple[str, ...], poles: int) -> tuple[Disturbance, ...]:
    """Return the disturbances to add, by name; ValueError if one is not possible."""
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
                raise ValueError(f"{name!r} names state {state!r}, which is disturbed {same}")
        # A disturbance that is alone has the plain names, which `disturbances_of` knows in a model
        # of one's own as well. A second one needs names that say what it acts on.
        ending = f"_{name}" if len(on) > 1 or model.disturbances else ""
        lags = tuple(f"w{i + 1}_{name}" for i in range(poles))
        added.append(Disturbance(name, state, f"sigma_w{ending}", f"tau_w{ending}", lags))
    # A clash would hide the model's own field: its equations would read the disturbance.
    taken = {*naming.names(model.Params), *naming.names(model.State)}
    for d in added:
        for clash in sorted(taken & {d.sigma, d.tau, *d.lags}):
            raise ValueError(
                f"model {model.name} has {clash!r} already, the name that a disturbance on "
                f"{d.name!r} gives to one of its own"
            )
    return tuple(added)


def _check_pushed(model: Model, name: str, state: str, rates: dict[str, str]) -> None:
    """Refuse what is neither an axis nor a state that can be pushed."""
    allowed = disturbable_states(model)
    known = list(dict.fromkeys([*rates, *allowed]))
    expected = f"expected one of {', '.join(known)}" if known else "which has none to disturb"
    if state in allowed:
        return
    if state in naming.names(model.State):
        raise ValueError(
            f"model {model.name}: the derivative of {name!r} is kinematics, another state and "
            f"nothing else, which nothing can push; {expected}"
        )
    raise ValueError(f"model {model.name} has no axis or state {name!r} to disturb, {expected}")


def _pushed_unit(model: Model, state: str) -> str:
    """The unit of a state's derivative: heave is no rotation."""
    unit = naming.unit(model.State, state) or "rad/s"
    return f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"


def _felt(model: Model, added: tuple[Disturbance, ...]) -> tuple[tuple[str, str, float], ...]:
    """The outputs that are the derivative of a pushed state, or its negative: their names, the lag
    that pushes, and the sign.

    Found by two evaluations, as `disturbable_states` finds kinematics. The unit has to be that of
    the derivative: an output that is a state may have the number of one.
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
    at = [_anywhere(model, rng) for _ in range(2)]
    # To single precision, in which the model may have been evaluated.
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


def _anywhere(model: Model, rng: np.random.Generator) -> tuple[dict[str, float], dict[str, float]]:
    """A model's rates and outputs at numbers that no formula makes of one another."""
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
    """The classes of parameters and states with those of the disturbances."""
    parameters, states = {}, {}
    for d in added:
        unit, of = _pushed_unit(model, d.state), f" on {d.name}" if len(added) > 1 else ""
        # Zero by default: without a value for it the model flies as the undisturbed one does.
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
    """The functions of a disturbed model, around those of the model itself."""

    model: Model
    added: tuple[Disturbance, ...]
    State: type
    felt: tuple[tuple[str, str, float], ...]
    """outputs that are the derivative of a pushed state: name, lag that pushes, sign"""

    def undisturbed(self, state: Record) -> Record:
        """The State of the model itself."""
        states = naming.names(self.model.State)
        return self.model.State(**{n: getattr(state, n) for n in states})

    def vector_field(self, p: Record, s: Record, u: Record) -> Record:
        """The model's derivatives with the pushes on them, and those of the pushes."""
        # It adds to the derivative, as a gust's moment over the inertia would: a disturbance of
        # the angle itself would jump, and one of the output would not act back through the flybar.
        rates = naming.asdict(self.model.vector_field(p, self.undisturbed(s), u))
        for d in self.added:
            rates[d.state] = rates[d.state] + getattr(s, d.lags[-1])
            rates |= _filtered(d, p, s)
        return self.State(**rates)

    def output(self, p: Record, s: Record, u: Record) -> Record:
        """The model's outputs: a push shows in them by the motion, and in those that are the
        derivative that it adds to.
        """
        outputs = self.model.output(p, self.undisturbed(s), u)
        # Left out of an accelerometer's reading, a gust would be taken for noise that has a memory,
        # and the filter for one of another size and time.
        pushed = {
            name: getattr(outputs, name) + sign * getattr(s, lag) for name, lag, sign in self.felt
        }
        return naming.replace(outputs, **pushed) if pushed else outputs

    def limits(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """The model's limits, by name."""
        assert self.model.limits is not None
        return self.model.limits(p, self.undisturbed(s), u)

    def noise_intensity(self, p: Record) -> Record:
        own = self.model.noise_intensity
        # Zeros made of a parameter have its type and its batch axis.
        zero = 0.0 * getattr(p, self.added[0].sigma)
        intensity = dict.fromkeys(naming.names(self.State), zero)
        intensity |= naming.asdict(own(p)) if own is not None else {}
        for d in self.added:
            # A first-order lag driven by q has the variance q^2 tau/2: q is chosen for sigma_w^2.
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
            # The gusts blew before the record began, so w has its stationary spread at the first
            # sample. Zero there would call the first tau_w seconds calm, and a filter would trust
            # them too much.
            sds |= dict.fromkeys(d.lags, getattr(p, d.sigma))
        return sds

    def correlation(self, p: Record) -> dict[tuple[str, str], Any]:
        own = self.model.correlation
        pairs = dict(own(p)) if own is not None else {}
        # The Lyapunov equation of two equal lags: E[w1 w2] = gain/2 E[w1^2], whatever tau_w is.
        for d in self.added:
            if len(d.lags) == 2:
                pairs[d.lags[0], d.lags[1]] = 0.5 * _gain(d) + 0.0 * getattr(p, d.sigma)
        return pairs


def _gain(d: Disturbance) -> float:
    # Two equal lags halve the variance of the first; the gain brings it back.
    return 2.0**0.5 if len(d.lags) == 2 else 1.0


def _filtered(d: Disturbance, p: Record, s: Record) -> dict[str, Scalar]:
    """The derivatives of a disturbance's own states."""
    rates: dict[str, Scalar] = {}
    before: Scalar | None = None
    # The first lag is driven by white noise alone, which is not in the field: `noise_intensity` has
    # it. Each further one follows the one before.
    for name in d.lags:
        w = getattr(s, name)
        pull = -w if before is None else _gain(d) * before - w
        # The same time constant for both lags: with one more of its own, a fit could not tell which
        # is which.
        rates[name], before = pull / getattr(p, d.tau), w
    return rates


def sensor_noise(output: str) -> str:
    """The parameter that is the sd of an output's noise from before its filters, as it is behind
    them."""
    return f"sigma_n_{output}"


@functools.cache
def with_sensor_noise(model: Model, outputs: tuple[str, ...]) -> Model:
    """The model with white noise of the sensors of some outputs before their low-passes.

    Each brings a parameter `sigma_n_OUTPUT`, the standard deviation behind the filters, in the
    output's unit. Noise that is white at the filter's input is process noise on the filter's state.

    Args:
        model: with `Model.low_passes` for these outputs.
    """
    if not outputs:
        return model
    added = tuple(p for p in model.low_passes if p.output in outputs)
    more = {}
    for p in added:
        unit = naming.unit(model.Outputs, p.output) or "1"
        meaning = f"sd of the noise of {p.output} that came through its filters"
        more[sensor_noise(p.output)] = (Annotated[Scalar, unit, meaning], 0.0)
    noisy = _Noisy(model, added)
    return dataclasses.replace(
        model,
        Params=naming.extended(model.Params, f"{model.Params.__name__}SensorNoise", more),
        noise_intensity=noisy.noise_intensity,
    )


class _Noisy(NamedTuple):
    """A model with the noise of sensors beside its own process noise."""

    model: Model
    added: tuple[LowPass, ...]

    def noise_intensity(self, p: Record) -> Record:
        own = self.model.noise_intensity
        # Zeros made of a parameter have its type and its batch axis.
        zero = 0.0 * getattr(p, sensor_noise(self.added[0].output))
        intensity = dict.fromkeys(naming.names(self.model.State), zero)
        intensity |= naming.asdict(own(p)) if own is not None else {}
        for low_pass in self.added:
            sd = getattr(p, sensor_noise(low_pass.output))
            intensity[low_pass.state] = low_pass.intensity * sd
        return self.model.State(**intensity)
