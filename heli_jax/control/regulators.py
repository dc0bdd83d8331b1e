"""Linear-quadratic regulators and PID cascades from a model linearised in steady flight."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.control.controller import commanded, in_loop, measured, signals_of
from heli_jax.control.laws import Cascade, Loop, Observer, StateFeedback
from heli_jax.control.loops import (
    Plant,
    controller_responses,
    growth,
    linear_step,
    plant_of,
    plant_responses,
    sampled_loop,
    sensitivity,
)
from heli_jax.dynamics.model import Model
from heli_jax.errors import require_known

_CLEAR = 0.5
"""Least cosine of a response's phase, from that of an integrating or constant one, that decides the
sign of a gain."""


class _Plant(NamedTuple):
    """A model linearised in steady flight, without states that no weighted signal depends on."""

    A: np.ndarray
    B: np.ndarray
    """Columns of the commanded inputs."""
    states: tuple[str, ...]
    signals: dict[str, np.ndarray]
    """Rows of states and outputs by name, as functions of the states."""
    at: dict[str, float]
    """Values of the signals in steady flight."""
    drives: dict[str, np.ndarray]
    """Effects (n,) on the states' rates of every input, and of a noise on each state's rate."""


def lqr(
    model: Model,
    params: Any,
    trimmed: Any,
    *,
    most: Mapping[str, float],
    dt: float,
    integral: Mapping[str, float] | None = None,
    references: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
) -> StateFeedback:
    r"""Return the linear-quadratic regulator, as feedback of the true states.

    It minimises $\int \sum_j (e_j/m_j)^2 + \sum_i (u_i/m_i)^2\,dt$, with m the largest acceptable
    deviations (Bryson's rule). The solution is that of continuous time; `loop_margins` shows what
    sampling costs.

    Args:
        model: one vehicle, without its controller.
        trimmed: a `Trim`, or a record with `state` and `inputs`.
        most: largest acceptable deviation of signals (states, outputs) and of the commanded inputs,
            SI. Inputs that are not named are not commanded.
        dt: sample time of the controller [s].
        integral: largest acceptable integral of a signal's deviation [SI times s]; it removes the
            signal's steady error.
        references: signals with a set point, among those of `most`; each equals a state.
        limits: largest commands by input.

    Raises:
        ValueError: an unknown name, a weight that is not above zero, or no stabilising solution.
    """
    integral = dict(integral or {})
    driven = _driven(model, {**most, **integral})
    plant = _plant(model, params, trimmed, driven, (*most, *integral))
    K = _regulator(plant, most, integral)
    n = len(plant.states)
    # An output with a set point is fed back in place of the state that it equals.
    read = {_state_of(plant, name): name for name in references}
    signals = [read.get(s, s) for s in plant.states]
    return StateFeedback(
        gains=_table(driven, signals, K[:, :n]),
        integral=_table(driven, tuple(integral), -K[:, n:]) if integral else {},
        dt=dt,
        references=tuple(references),
        about={s: plant.at[s] for s in (*signals, *integral) if s not in references},
        limits=dict(limits or {}),
    )


def lqg(
    model: Model,
    params: Any,
    trimmed: Any,
    *,
    most: Mapping[str, float],
    sd: Mapping[str, float],
    noise: Mapping[str, float],
    dt: float,
    references: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
) -> Observer:
    """Return the linear-quadratic regulator on the estimate of a stationary Kalman filter.

    Args:
        sd: standard deviation of the white noise of each measured output, SI.
        noise: square root of the spectral density of white noise [SI times sqrt(s)] at inputs (such
            as wind), or of the rates of states.
        references: measured outputs with a set point; each equals a state.

    Other arguments and errors are those of `lqr`.
    """
    driven = _driven(model, most)
    outputs = naming.names(model.Outputs)
    require_known(sd, outputs, "sd", f"model {model.name} has no output")
    plant = _plant(model, params, trimmed, driven, (*most, *sd))
    K = _regulator(plant, most, {})
    n = len(plant.states)
    A, B = _discrete(plant.A, plant.B, dt)
    C = np.stack([plant.signals[name] for name in sd])
    G = _noise_columns(plant, noise, model.name)
    R = np.diag(np.square(list(sd.values())))
    # Van Loan's integral of the noise over a sample.
    both = scipy.linalg.expm(dt * np.block([[-plant.A, G @ G.T], [np.zeros((n, n)), plant.A.T]]))
    Q = both[n:, n:].T @ both[:n, n:]
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, 0.5 * (Q + Q.T), R)
    except (np.linalg.LinAlgError, ValueError) as e:
        raise ValueError(
            f"sd: the measured outputs {', '.join(sd)} do not show all states that the regulator "
            f"needs ({', '.join(plant.states)})"
        ) from e
    M = np.linalg.solve(C @ P @ C.T + R, C @ P).T
    return Observer(
        gains=_table(driven, plant.states, K),
        A=jnp.asarray(A),
        B=jnp.asarray(B),
        C=jnp.asarray(C),
        M=jnp.asarray(M),
        dt=dt,
        references=tuple(references),
        place={name: _state_of(plant, name) for name in references},
        about={name: plant.at[name] for name in sd},
        states=plant.states,
        inputs=driven,
        limits=dict(limits or {}),
    )


def pid(
    model: Model,
    params: Any,
    trimmed: Any,
    *,
    loops: Mapping[str, Mapping[str, float]],
    dt: float,
    integral: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
) -> Cascade:
    """Return a cascade whose loops have the given crossover frequencies.

    Loops are closed from the innermost outwards, each by the gain that makes its own response one
    at the crossover, with the loops within it closed. Integrals act below a fifth of the crossover.

    Args:
        loops: by commanded input, the crossover [rad/s] of each signal, the outermost first.
        integral: signals with an integral.
        limits: largest outputs of loops by signal: the set point of the next loop, or the command.

    Other arguments and errors are those of `lqr`.
    """
    limits = dict(limits or {})
    signals = [s for by in loops.values() for s in by]
    words = f"model {model.name} has no"
    require_known((*signals, *integral, *limits), signals_of(model), "loops", f"{words} signal")
    require_known(loops, naming.names(model.Inputs), "loops", f"{words} input")
    model, state = _in_flight(model, params, trimmed, loops)
    plant = plant_of(model, params, state, trimmed.inputs, dt)
    at = dict(zip(signals_of(model), np.asarray(plant.at), strict=True))
    about = {s: float(at[s]) for s in signals}
    done: dict[str, tuple[Loop, ...]] = {}
    for name, by in loops.items():
        inner: tuple[Loop, ...] = ()
        for signal, crossover in reversed(list(by.items())):
            if not 0.0 < crossover < np.pi / dt:
                raise ValueError(
                    f"{name}.{signal}: expected a crossover between 0 and {np.pi / dt:.3g} rad/s "
                    f"(half the sample rate), got {crossover:g}"
                )
            H = _response(model, plant, {**done, name: inner}, about, dt, name, signal, crossover)
            if not (np.isfinite(H) and abs(H) > 0.0):
                raise ValueError(f"{name}: {signal} does not follow this input")
            # The phase of an integrating or a constant response decides the sign, elsewhere the
            # slower growth.
            p, along = 1.0 / abs(H), np.cos(np.angle(H) + 0.25 * np.pi)
            made = [
                (Loop(k, 0.2 * crossover * k if signal in integral else None, None, signal,
                      limits.get(signal)), *inner)
                for k in (p, -p)
            ]  # fmt: skip
            if abs(along) > _CLEAR:
                inner = made[int(along < 0.0)]
            else:
                laws = [_cascade({**done, name: by}, about, dt) for by in made]
                grown = [float(growth(sampled_loop(model, plant, law), dt)) for law in laws]
                inner = made[int(np.argmin(grown))]
        done[name] = inner
    return _cascade(done, about, dt)


def _cascade(
    loops: Mapping[str, tuple[Loop, ...]], about: Mapping[str, float], dt: float
) -> Cascade:
    """Return a cascade with set points of its outermost loops."""
    first = tuple(by[0].signal for by in loops.values())
    return Cascade(loops=dict(loops), dt=dt, references=first, about=dict(about))


def _response(
    model: Model,
    plant: Plant,
    loops: Mapping[str, tuple[Loop, ...]],
    about: Mapping[str, float],
    dt: float,
    name: str,
    signal: str,
    omega: float,
) -> complex:
    """Return the response of a signal to the set point of the outermost loop, or to the command."""
    inner = loops[name]
    # A loop of gain zero makes the input a command.
    whole = {**loops, name: inner or (Loop(0.0, signal=signal),)}
    controller = _cascade(whole, about, dt)
    at = np.asarray([omega])
    P = plant_responses(model, plant, controller, dt, at)
    K, R = controller_responses(linear_step(model, plant, controller), dt, at)
    moved = P @ sensitivity(K, P) @ (R if inner else jnp.eye(K.shape[-2], dtype=K.dtype)[None])
    # Set points are in the order of the loops, commands in that of the model's inputs.
    column = (tuple(whole) if inner else commanded(model, controller)).index(name)
    return complex(moved[0, signals_of(model).index(signal), column])


def _in_flight(model: Model, params: Any, trimmed: Any, driven: Iterable[str]) -> tuple[Model, Any]:
    """Return the model with delay lines, and its state in steady flight."""
    model = in_loop(model, driven)
    own = naming.asdict(model.initial_state(params)) | naming.asdict(trimmed.state)
    return model, model.State(**own)


def _driven(model: Model, most: Mapping[str, float]) -> tuple[str, ...]:
    """Return the commanded inputs among the weights.

    Raises:
        ValueError: an unknown name, a weight that is not above zero, or no input.
    """
    inputs = naming.names(model.Inputs)
    words = f"model {model.name} has no signal or input"
    require_known(most, (*signals_of(model), *inputs), "most", words)
    for name, value in most.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"most.{name}: expected a number above zero, got {value:g}")
    driven = tuple(n for n in most if n in inputs)
    if not driven:
        raise ValueError(f"most: expected at least one input of {', '.join(inputs)}, got none")
    return driven


def _plant(
    model: Model, params: Any, trimmed: Any, driven: Sequence[str], needed: Iterable[str]
) -> _Plant:
    """Return the continuous plant with the states that the needed signals depend on."""
    model, state = _in_flight(model, params, trimmed, driven)
    linear = linearize(model, params, state, trimmed.inputs)
    A, B, C, D = (np.asarray(M, np.float64) for M in linear.matrices)
    rows = dict(zip(linear.states, np.eye(len(A)), strict=True))
    feedthrough = dict.fromkeys(linear.states, np.zeros(B.shape[1]))
    rows |= dict(zip(linear.outputs, C, strict=True))
    feedthrough |= dict(zip(linear.outputs, D, strict=True))
    columns = [linear.inputs.index(n) for n in driven]
    weighted = [n for n in needed if n in rows]
    for name in weighted:
        if np.any(feedthrough[name][columns]):
            raise ValueError(f"{name}: expected a signal that no command changes at once")
    # States that only integrate others, such as a position without weight, have no regulator.
    kept = np.any([rows[n] != 0.0 for n in weighted], axis=0)
    for _ in range(len(A)):
        kept |= np.any(A[kept] != 0.0, axis=0)
    signals = measured(model, params, state, trimmed.inputs)
    return _Plant(
        A[np.ix_(kept, kept)],
        B[np.ix_(kept, columns)],
        tuple(n for n, k in zip(linear.states, kept, strict=True) if k),
        {n: row[kept] for n, row in rows.items()},
        {n: float(v) for n, v in signals.items()},
        {n: row[kept] for n, row in zip(linear.states, np.eye(len(A)), strict=True)}
        | {n: column[kept] for n, column in zip(linear.inputs, B.T, strict=True)},
    )


def _regulator(
    plant: _Plant, most: Mapping[str, float], integral: Mapping[str, float]
) -> np.ndarray:
    """Return K of u = -K (x, integrals), of the continuous Riccati equation."""
    n, m = plant.B.shape
    weighted = [plant.signals[s] / w for s, w in most.items() if s in plant.signals]
    effort = [w for s, w in most.items() if s not in plant.signals]
    C = np.stack([plant.signals[s] for s in integral]) if integral else np.zeros((0, n))
    k = len(C)
    # Integrals of the set point less the signal.
    A = np.block([[plant.A, np.zeros((n, k))], [-C, np.zeros((k, k))]])
    B = np.concatenate([plant.B, np.zeros((k, m))])
    rows = np.concatenate(
        [
            np.pad(np.reshape(weighted, (-1, n)), ((0, 0), (0, k))),
            np.pad(np.diag([1.0 / w for w in integral.values()]).reshape(k, k), ((0, 0), (n, 0))),
        ]
    )
    R = np.diag(1.0 / np.square(effort))
    try:
        P = scipy.linalg.solve_continuous_are(A, B, rows.T @ rows, R)
    except np.linalg.LinAlgError as e:
        raise ValueError(
            "most: no regulator stabilises these signals with these inputs; expected inputs that "
            "reach all of them, and weights on signals that show every unstable mode"
        ) from e
    return np.linalg.solve(R, B.T @ P)


def _table(
    driven: Sequence[str], columns: Sequence[str], K: np.ndarray
) -> dict[str, dict[str, Any]]:
    return {
        n: dict(zip(columns, map(float, row), strict=True))
        for n, row in zip(driven, K, strict=True)
    }


def _discrete(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    n, m = B.shape
    Phi = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((m, n + m))]]))
    return Phi[:n, :n], Phi[:n, n:]


def _noise_columns(plant: _Plant, noise: Mapping[str, float], name: str) -> np.ndarray:
    """Return the effect of the white noises on the states, (n, noises), for the model `name`."""
    require_known(noise, plant.drives, "noise", f"model {name} has no input or state")
    columns = [size * plant.drives[n] for n, size in noise.items()]
    return np.reshape(columns, (len(columns), len(plant.states))).T


def _state_of(plant: _Plant, name: str) -> str:
    """Return the state that an output equals.

    Raises:
        ValueError: it is no single state.
    """
    row = plant.signals.get(name, np.zeros(0))
    at = np.flatnonzero(row)
    if len(at) != 1 or row[at[0]] != 1.0:
        raise ValueError(f"references: expected signals that equal a weighted state, got {name!r}")
    return plant.states[at[0]]
