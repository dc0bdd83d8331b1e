"""A disturbance as part of the model: a random acceleration with a memory."""

import functools
from typing import Annotated, Any, NamedTuple

from heli_jax import naming
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Model, axes_of
from heli_jax.naming import Record, Scalar


def disturbable(model: Model) -> list[str]:
    """The axes of a model that can be disturbed, by name."""
    return [axis.name for axis in axes_of(model)]


# Cached: a model is static to jit, and a second one of the same kind would be compiled again.
@functools.cache
def with_disturbance(model: Model, axis: str, poles: int = 1) -> Model:
    r"""The model with an Ornstein-Uhlenbeck (Gauss-Markov) acceleration on one axis.

    $\dot w = -w/\tau_w + \sigma_w\sqrt{2/\tau_w}\,n$ with white noise n of unit intensity, so that
    w has the standard deviation sigma_w [rad/s^2] and correlation time tau_w [s]. With two poles
    w follows a second lag of the same time constant, scaled to the same standard deviation. The
    model gains the parameters `sigma_w` (default 0) and `tau_w` (default 1 s). At the first sample
    the disturbance is what it is at any other: all its states have the standard deviation sigma_w,
    and the two of two poles the correlation 1/sqrt(2).

    Args:
        model: without a disturbance on that axis.
        axis: its name, one of `disturbable`.
        poles: 1 or 2, the order of the filter that colours the noise.

    Raises:
        ValueError: the model has no such axis, or `poles` is neither 1 nor 2.
    """
    check_model(model)
    rates = {known.name: known.rate for known in axes_of(model)}
    if axis not in rates:
        expected = f"one of {', '.join(rates)}" if rates else "a model that turns about an axis"
        raise ValueError(f"model {model.name} has no axis {axis!r} to disturb, expected {expected}")
    if poles not in (1, 2):
        raise ValueError(f"poles must be 1 or 2, got {poles}")
    lags = tuple(f"w{i + 1}_{axis}" for i in range(poles))
    Params, State = _records(model, lags, _acceleration(model, rates[axis]))
    disturbed = _Disturbed(model, rates[axis], lags, State)
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
        correlation=None if poles == 1 else disturbed.correlation,
        limits=None if model.limits is None else disturbed.limits,
        axes=model.axes,
        delays=model.delays,
        positive=model.positive,
    )


def _acceleration(model: Model, rate: str) -> str:
    """The unit of a rate's derivative: heave is no rotation."""
    unit = naming.unit(model.State, rate) or "rad/s"
    return f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"


def _records(model: Model, lags: tuple[str, ...], unit: str) -> tuple[type, type]:
    """The classes of parameters and states with those of the disturbance, whose unit is given."""
    Params = naming.extended(
        model.Params,
        f"{model.Params.__name__}Disturbed",
        {
            # Zero by default: without a value for it the model flies as the undisturbed one does.
            "sigma_w": (Annotated[Scalar, unit, "disturbance standard deviation"], 0.0),
            "tau_w": (Annotated[Scalar, "s", "disturbance correlation time"], 1.0),
        },
    )
    State = naming.extended(
        model.State,
        f"{model.State.__name__}Disturbed",
        dict.fromkeys(lags, (Annotated[Scalar, unit, "disturbance acceleration"], None)),
    )
    return Params, State


class _Disturbed(NamedTuple):
    """The functions of a disturbed model, around those of the model itself."""

    model: Model
    rate: str
    """the state whose derivative the disturbance adds to"""
    lags: tuple[str, ...]
    """the states of the filter, the one that is driven by white noise first"""
    State: type

    @property
    def gain(self) -> float:
        # Two equal lags halve the variance of the first; the gain brings it back.
        return 2.0**0.5 if len(self.lags) == 2 else 1.0

    def undisturbed(self, state: Record) -> Record:
        """The State of the model itself."""
        states = naming.names(self.model.State)
        return self.model.State(**{n: getattr(state, n) for n in states})

    def vector_field(self, p: Record, s: Record, u: Record) -> Record:
        # It adds to the acceleration, as a gust's moment over the inertia would: a disturbance of
        # the angle itself would jump, and one of the output would not act back through the flybar.
        rates = naming.asdict(self.model.vector_field(p, self.undisturbed(s), u))
        rates[self.rate] = rates[self.rate] + getattr(s, self.lags[-1])
        before: Scalar | None = None
        # The first lag is driven by white noise alone, which is not in the field: `noise_intensity`
        # has it. Each further one follows the one before.
        for name in self.lags:
            w = getattr(s, name)
            pull = -w if before is None else self.gain * before - w
            rates[name], before = pull / p.tau_w, w
        return self.State(**rates)

    def output(self, p: Record, s: Record, u: Record) -> Record:
        return self.model.output(p, self.undisturbed(s), u)

    def limits(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        assert self.model.limits is not None
        return self.model.limits(p, self.undisturbed(s), u)

    def noise_intensity(self, p: Record) -> Record:
        # Zeros made of a parameter have its type and its batch axis.
        zero = 0.0 * p.sigma_w
        intensity = dict.fromkeys(naming.names(self.State), zero)
        # A first-order lag driven by q has the variance q^2 tau/2: q is chosen for sigma_w^2.
        intensity[self.lags[0]] = p.sigma_w * (2.0 / p.tau_w) ** 0.5
        return self.State(**intensity)

    def start(self, p: Record) -> Record:
        zero = 0.0 * p.sigma_w
        start = naming.asdict(self.model.initial_state(p))
        return self.State(**{**start, **dict.fromkeys(self.lags, zero)})

    def initial_sd(self, p: Record) -> dict[str, Any]:
        return dict.fromkeys(self.lags, p.sigma_w)

    def correlation(self, p: Record) -> dict[tuple[str, str], Any]:
        # The Lyapunov equation of two equal lags: E[w1 w2] = gain/2 E[w1^2], whatever tau_w is.
        first, second = self.lags
        return {(first, second): 0.5 * self.gain + 0.0 * p.sigma_w}
