"""A disturbance as part of the model: a random acceleration with a memory."""

import functools
from typing import Annotated, Any

from heli_jax import naming
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Model
from heli_jax.naming import Scalar

_RATES = {"roll": "dphi", "pitch": "dtheta", "yaw": "dpsi"}


def disturbable(model: Model) -> list[str]:
    """The axes of a model that can be disturbed."""
    return [axis for axis, rate in _RATES.items() if rate in naming.names(model.State)]


@functools.cache
def with_disturbance(model: Model, axis: str, poles: int = 1) -> Model:
    r"""The model with an Ornstein-Uhlenbeck (Gauss-Markov) acceleration on one axis.

    $\dot w = -w/\tau_w + \sigma_w\sqrt{2/\tau_w}\,n$ with white noise n of unit intensity, so that
    w has the standard deviation sigma_w [rad/s^2] and correlation time tau_w [s]. With two poles
    w follows a second lag of the same time constant, scaled to the same standard deviation. The
    model gains the parameters `sigma_w` (default 0) and `tau_w` (default 1 s). At the first sample
    the disturbance is what it is at any other: all its states have the standard deviation sigma_w,
    and the two of two poles the correlation 1/sqrt(2).

    Raises:
        ValueError: the model has no such axis, or `poles` is neither 1 nor 2.
    """
    check_model(model)
    have = disturbable(model)
    if axis not in have:
        raise ValueError(f"model {model.name} has no axis {axis!r} to disturb; it has {have}")
    if poles not in (1, 2):
        raise ValueError(f"poles is {poles}, wanted is 1 or 2")
    rate, chain = _RATES[axis], [f"w{i + 1}_{axis}" for i in range(poles)]
    Params = naming.extended(
        model.Params,
        f"{model.Params.__name__}Disturbed",
        {
            "sigma_w": (Annotated[Scalar, "rad/s^2", "disturbance standard deviation"], 0.0),
            "tau_w": (Annotated[Scalar, "s", "disturbance correlation time"], 1.0),
        },
    )
    State = naming.extended(
        model.State,
        f"{model.State.__name__}Disturbed",
        dict.fromkeys(chain, (Annotated[Scalar, "rad/s^2", "disturbance acceleration"], None)),
    )
    # Two equal lags halve the variance of the first; the gain brings it back.
    gain = 2.0**0.5 if poles == 2 else 1.0
    limits = model.limits

    def inner(state: Any) -> Any:
        return model.State(**{n: getattr(state, n) for n in naming.names(model.State)})

    def vector_field(p: Any, s: Any, u: Any) -> Any:
        rates = naming.asdict(model.vector_field(p, inner(s), u))
        rates[rate] = rates[rate] + getattr(s, chain[-1])
        before: Scalar | None = None
        for name in chain:
            w = getattr(s, name)
            pull = -w if before is None else gain * before - w
            rates[name], before = pull / p.tau_w, w
        return State(**rates)

    def noise(p: Any) -> Any:
        zero = 0.0 * p.sigma_w
        intensity = dict.fromkeys(naming.names(State), zero)
        intensity[chain[0]] = p.sigma_w * (2.0 / p.tau_w) ** 0.5
        return State(**intensity)

    def start(p: Any) -> Any:
        zero = 0.0 * p.sigma_w
        return State(**{**naming.asdict(model.initial_state(p)), **dict.fromkeys(chain, zero)})

    def correlation(p: Any) -> Any:
        # The Lyapunov equation of two equal lags: E[w1 w2] = gain/2 E[w1^2], whatever tau_w is.
        return {(chain[0], chain[1]): 0.5 * gain + 0.0 * p.sigma_w}

    return Model(
        f"{model.name}-disturbed",
        vector_field,
        lambda p, s, u: model.output(p, inner(s), u),
        Params,
        State,
        model.Inputs,
        model.Outputs,
        linear=model.linear,
        start=start,
        noise=noise,
        spread=lambda p: dict.fromkeys(chain, p.sigma_w),
        correlation=None if poles == 1 else correlation,
        limits=None if limits is None else lambda p, s, u: limits(p, inner(s), u),
    )
