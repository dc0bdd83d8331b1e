r"""Control laws: state feedback with integrals, an observer with state feedback, and PID cascades.

Each acts on deviations from set points, so that its command is zero in steady flight. Commands are
in the unit of the input, and are limited on request; integrals stop while their command is limited.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.control.controller import Controller, Signals
from heli_jax.naming import Scalar

type _Pairs = tuple[tuple[str, Any], ...]


def _pairs(values: Mapping[str, Any] | _Pairs) -> _Pairs:
    """Return a mapping as pairs, which JAX can compare."""
    return tuple(values.items() if isinstance(values, Mapping) else values)


def _limited(value: Any, most: float | None) -> tuple[Any, Any]:
    """Return a limited command, and 1 where it is within the limits, else 0."""
    if most is None:
        return value, 1.0
    return jnp.clip(value, -most, most), jnp.where(jnp.abs(value) < most, 1.0, 0.0)


class StateFeedback(Controller):
    """Commands from deviations of signals, and from integrals of deviations.

    $u_i = \\sum_j k_{ij} e_j + \\sum_j k^I_{ij} \\int e_j\\,dt$, with $e_j$ the set point less the
    signal.
    """

    gains: dict[str, dict[str, Scalar]]
    """Gains by input and signal [input per signal]."""
    integral: dict[str, dict[str, Scalar]]
    """Gains on the integrals by input and signal [input per signal and second]."""
    dt: float = eqx.field(static=True)
    references: tuple[str, ...] = eqx.field(static=True)
    """Signals with a set point; the others have those of `about`."""
    about: _Pairs = eqx.field(static=True, converter=_pairs, default=())
    """Values of signals without a set point in steady flight; default: zero."""
    limits: _Pairs = eqx.field(static=True, converter=_pairs, default=())
    """Largest command by input."""

    def init(self) -> dict[str, Any]:
        """Return zero integrals."""
        return dict.fromkeys({n: None for by in self.integral.values() for n in by}, 0.0)

    def step(
        self, state: dict[str, Any], measurement: Signals, reference: Signals
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the integrals after the sample, and the commands."""
        about, limits = dict(self.about), dict(self.limits)

        def error(name: str) -> Any:
            target = reference[name] if name in reference else about.get(name, 0.0)
            return target - measurement[name]

        command, free = {}, dict.fromkeys(state, 1.0)
        for name, by in self.gains.items():
            value = sum((k * error(n) for n, k in by.items()), start=jnp.zeros(()))
            value = value + sum(k * state[n] for n, k in self.integral.get(name, {}).items())
            command[name], within = _limited(value, limits.get(name))
            for n in self.integral.get(name, {}):
                free[n] = free[n] * within
        return {n: v + self.dt * free[n] * error(n) for n, v in state.items()}, command


class Observer(Controller):
    r"""State feedback on the estimate of a Kalman filter: LQG.

    The filter is that of the model linearised at steady flight, $\hat x^+ = \hat x + M(y - C\hat
    x)$, $\hat x' = A\hat x^+ + B u$, in deviations. The command is $u = K(x_r - \hat x^+)$.
    """

    gains: dict[str, dict[str, Scalar]]
    """Gains by input and state."""
    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    C: Float[Array, "p n"]
    M: Float[Array, "n p"]
    """Discrete matrices of the model, and the filter's gain."""
    dt: float = eqx.field(static=True)
    references: tuple[str, ...] = eqx.field(static=True)
    """Outputs with a set point, each with one state of its own (`place`)."""
    place: _Pairs = eqx.field(static=True, converter=_pairs)
    """State whose set point follows that of an output."""
    about: _Pairs = eqx.field(static=True, converter=_pairs)
    """Values of the measured outputs in steady flight, in the order of C's rows."""
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    """States and commanded inputs, in the order of the matrices."""
    limits: _Pairs = eqx.field(static=True, converter=_pairs, default=())

    def init(self) -> dict[str, Any]:
        """Return the estimate in steady flight."""
        return dict.fromkeys(self.states, 0.0)

    def step(
        self, state: dict[str, Any], measurement: Signals, reference: Signals
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the prediction for the next sample, and the commands."""
        x = jnp.stack([jnp.asarray(state[n]) for n in self.states])
        y = jnp.stack([measurement[n] - v for n, v in self.about])
        x = x + self.M @ (y - self.C @ x)
        about, place, limits = dict(self.about), dict(self.place), dict(self.limits)
        target = {place[n]: reference[n] - about[n] for n in self.references}
        at = dict(zip(self.states, x, strict=True))
        command = {}
        for name, by in self.gains.items():
            value = sum(k * (target.get(n, 0.0) - at[n]) for n, k in by.items())
            command[name], _ = _limited(value, limits.get(name))
        u = jnp.stack([jnp.asarray(command[n]) for n in self.inputs])
        x = self.A @ x + self.B @ u
        return dict(zip(self.states, x, strict=True)), command


class Loop(eqx.Module):
    """A PID law of one signal."""

    p: Scalar
    """Gain on the error."""
    i: Scalar | None = None
    """Gain on its integral [1/s]; None without one."""
    d: Scalar | None = None
    """Gain on the rate of the signal [s]; None without one."""
    signal: str = eqx.field(static=True, default="")
    limit: float | None = eqx.field(static=True, default=None)
    """Largest set point of the next loop, or command."""
    lag: float = eqx.field(static=True, default=0.0)
    """Time constant of the rate's low-pass [s]."""


class Cascade(Controller):
    """Nested PID loops for each input, from outer to inner.

    Each loop's output is the deviation of the next loop's set point from `about`, and the last
    one's is the command.
    """

    loops: dict[str, tuple[Loop, ...]]
    """Loops by input, the outermost first."""
    dt: float = eqx.field(static=True)
    references: tuple[str, ...] = eqx.field(static=True)
    """Signals of the outermost loops."""
    about: _Pairs = eqx.field(static=True, converter=_pairs, default=())
    """Values of the inner loops' signals in steady flight; default: zero."""

    def init(self) -> dict[str, Any]:
        """Return zero integrals, and unset derivatives."""
        about, state = dict(self.about), {}
        for loop in (loop for loops in self.loops.values() for loop in loops):
            if loop.i is not None:
                state[f"{loop.signal}_i"] = 0.0
            if loop.d is not None:
                state |= {
                    f"{loop.signal}_before": about.get(loop.signal, 0.0),
                    f"{loop.signal}_rate": 0.0,
                }
        return state

    def step(
        self, state: dict[str, Any], measurement: Signals, reference: Signals
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return integrals and filtered rates after the sample, and the commands."""
        about, state, command = dict(self.about), dict(state), {}
        for name, loops in self.loops.items():
            target = reference[loops[0].signal]
            for loop, inner in zip(loops, (*loops[1:], None), strict=True):
                value, changed = _pid(
                    loop,
                    state,
                    target - measurement[loop.signal],
                    measurement[loop.signal],
                    self.dt,
                )
                state |= changed
                target = value if inner is None else value + about.get(inner.signal, 0.0)
            command[name] = target
        return state, command


def _pid(
    loop: Loop, state: Mapping[str, Any], error: Any, signal: Any, dt: float
) -> tuple[Any, dict[str, Any]]:
    """Return the limited output of a loop, and its states after the sample."""
    value, changed = loop.p * error, {}
    if loop.i is not None:
        value = value + loop.i * state[f"{loop.signal}_i"]
    if loop.d is not None:
        # The rate of the signal, not of the error: a step of the set point gives no impulse.
        rate = (signal - state[f"{loop.signal}_before"]) / dt
        share = dt / (dt + loop.lag)
        rate = state[f"{loop.signal}_rate"] + share * (rate - state[f"{loop.signal}_rate"])
        changed |= {f"{loop.signal}_before": signal, f"{loop.signal}_rate": rate}
        value = value - loop.d * rate
    value, within = _limited(value, loop.limit)
    if loop.i is not None:
        changed[f"{loop.signal}_i"] = state[f"{loop.signal}_i"] + dt * within * error
    return value, changed


def content_of(controller: Controller) -> dict[str, Any]:
    """Return a law as content of a JSON file."""
    return {"law": type(controller).__name__, **_fields(controller)}


def _fields(record: Any) -> dict[str, Any]:
    return {
        n: _plain(dict(v) if n in ("about", "limits", "place") else v)
        for n, v in vars(record).items()
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Loop):
        return _fields(value)
    if isinstance(value, dict):
        return {n: _plain(v) for n, v in value.items()}
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return np.asarray(value).tolist()
