"""The R-50 in turbulence: a model with disturbances on six axes, and records in closed loop.

The helicopter is unstable, so a regulator holds the hover while the sticks move in steps. The
sticks then depend on the gusts. The records are made with SciPy's matrix exponentials, not with the
package's simulation.
"""

import functools
from typing import Annotated, Any, NamedTuple

import numpy as np
import scipy.linalg

from heli_jax import Flight, Free, Nuisance, Problem, linear_model, naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.naming import Scalar

DT = 0.02
AXES = ("p", "q", "r", "u", "v", "w")
SIGMA = {"p": 0.4, "q": 0.4, "r": 0.8, "u": 0.3, "v": 0.6, "w": 0.4}
"""Standard deviation of the turbulent acceleration [rad/s^2, m/s^2]."""
TAU = {"p": 0.4, "q": 0.5, "r": 0.7, "u": 2.0, "v": 2.0, "w": 1.0}
"""Correlation time of the turbulence [s]."""
NOISE = {"u": 0.05, "v": 0.05, "w": 0.05, "p": 0.02, "q": 0.02, "r": 0.02}
NOISE |= {"phi": 0.01, "theta": 0.01}
"""Standard deviation of the measurement noise [m/s, rad/s, rad]."""
FIXED = ("g", "Kr", "tau_ped")
"""Fixed parameters: only Kr Nrfb is identifiable, and the pedal's delay is a separate study."""
STICK = 0.2
"""Step size of each stick; the response to gusts is then 0.2 to 0.5 of the driven one."""


def _sigma(axis: str) -> str:
    # Filter error has one disturbance by name; the others are ordinary parameters.
    return "sigma_w" if axis == "w" else f"sigma_{axis}"


def _tau(axis: str) -> str:
    return "tau_w" if axis == "w" else f"tau_{axis}"


class _Turbulent(NamedTuple):
    """The R-50 with an Ornstein-Uhlenbeck acceleration on each of six axes."""

    model: Model
    State: type

    def vector_field(self, p: Any, s: Any, u: Any) -> Any:
        own = {n: getattr(s, n) for n in naming.names(self.model.State)}
        rates = naming.asdict(self.model.vector_field(p, self.model.State(**own), u))
        for axis in AXES:
            push = getattr(s, f"gust_{axis}")
            rates[axis] = rates[axis] + push
            rates[f"gust_{axis}"] = -push / getattr(p, _tau(axis))
        return self.State(**rates)

    def output(self, p: Any, s: Any, u: Any) -> Any:
        own = {n: getattr(s, n) for n in naming.names(self.model.State)}
        return self.model.output(p, self.model.State(**own), u)

    def noise_intensity(self, p: Any) -> Any:
        rates = dict.fromkeys(naming.names(self.State), 0.0 * p.sigma_w)
        for axis in AXES:
            # Scaled so that the disturbance has the standard deviation sigma.
            rates[f"gust_{axis}"] = getattr(p, _sigma(axis)) * (2.0 / getattr(p, _tau(axis))) ** 0.5
        return self.State(**rates)

    def initial_sd(self, p: Any) -> dict[str, Any]:
        return {f"gust_{axis}": getattr(p, _sigma(axis)) for axis in AXES}


@functools.cache
def turbulent() -> Model:
    """Return the model, with sigma and tau of each axis among its parameters."""
    model = linear_model("r50-hover").model
    number = Annotated[Scalar, "1", "of the turbulence"]
    parameters = {_sigma(a): (number, SIGMA[a]) for a in AXES}
    parameters |= {_tau(a): (number, TAU[a]) for a in AXES}
    gusts = {f"gust_{a}": (number, None) for a in AXES}
    State = naming.extended(model.State, "TurbulentState", gusts)
    functions = _Turbulent(model, State)
    return Model(
        "r50-turbulent",
        functions.vector_field,
        functions.output,
        naming.extended(model.Params, "TurbulentParams", parameters),
        State,
        model.Inputs,
        model.Outputs,
        linear=True,
        noise_intensity=functions.noise_intensity,
        initial_sd=functions.initial_sd,
        axes=model.axes,
        delays=model.delays,
        positive=(*model.positive, *parameters),
    )


def truth() -> Any:
    """Return the true parameters, SI."""
    values = naming.asdict(linear_model("r50-hover").vehicle().params)
    values |= {_sigma(a): SIGMA[a] for a in AXES} | {_tau(a): TAU[a] for a in AXES}
    return turbulent().Params(**{n: np.float64(v) for n, v in values.items()})


class _Step(NamedTuple):
    """One sample of the flight: x+ = A x + now u[k-d] + before u[k-d-1] + L noise."""

    A: np.ndarray
    now: np.ndarray
    before: np.ndarray
    whole: int
    """Delay d of the pedal [samples]."""
    L: np.ndarray


@functools.cache
def _step() -> _Step:
    model, params = turbulent(), truth()
    A, B, _, _ = (np.asarray(m) for m in jacobians(model, params))
    n, m = B.shape
    whole, rest = divmod(float(params.tau_ped), DT)

    def held(h: float) -> tuple[np.ndarray, np.ndarray]:
        E = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * h)
        return E[:n, :n], E[:n, n:]

    Ad, now = held(DT)
    (_, early), (late_A, late) = held(rest), held(DT - rest)
    pedal = naming.names(model.Inputs).index("ped")
    before = np.zeros_like(B)
    before[:, pedal], now[:, pedal] = late_A @ early[:, pedal], late[:, pedal]
    assert model.noise_intensity is not None
    g = np.array([float(v) for v in naming.asdict(model.noise_intensity(params)).values()])
    # Van Loan (1978): covariance of the noise of one sample.
    E = scipy.linalg.expm(np.block([[-A, np.diag(g**2)], [np.zeros((n, n)), A.T]]) * DT)
    values, vectors = np.linalg.eigh(E[n:, n:].T @ E[:n, n:])
    return _Step(Ad, now, before, int(whole), vectors * np.sqrt(np.maximum(values, 0.0)))


@functools.cache
def _regulator() -> np.ndarray:
    """Return gains (4, 13) of a quadratic regulator with a margin for the pedal's delay."""
    step = _step()
    A, B = step.A[:13, :13], (step.now + step.before)[:13]
    weights = {"u": 0.01, "v": 0.01, "w": 0.01, "p": 0.05, "q": 0.05, "r": 0.01, "phi": 1.0}
    weights |= {"theta": 1.0}
    Q = np.diag([weights.get(n, 1e-6) for n in naming.names(turbulent().State)[:13]])
    R = np.diag([10.0, 10.0, 10.0, 3.0])
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def record(seed: int, seconds: float = 60.0, turbulence: float = 1.0) -> Flight:
    """Return a flight in closed loop, with sticks that move in steps of 0.2 to 1.5 s.

    Args:
        seed: seed of all random numbers.
        seconds: duration [s].
        turbulence: factor of the gusts.
    """
    model, step, rng = turbulent(), _step(), np.random.default_rng(seed)
    N, n = round(seconds / DT), step.A.shape[0]
    steps = np.stack([_random_steps(rng, N) for _ in range(4)], axis=1)
    x, sticks, states = np.zeros(n), np.zeros((N, 4)), np.zeros((N, n))
    x[13:] = turbulence * rng.standard_normal(6) * [SIGMA[a] for a in AXES]
    pedal = naming.names(model.Inputs).index("ped")
    for k in range(N):
        states[k] = x
        sticks[k] = steps[k] - _regulator() @ x[:13]
        now, before = sticks[k].copy(), np.zeros(4)
        # The first sample is held before the record, as in the package.
        now[pedal] = sticks[max(k - step.whole, 0), pedal]
        before[pedal] = sticks[max(k - step.whole - 1, 0), pedal]
        gust = turbulence * step.L @ rng.standard_normal(n)
        x = step.A @ x + step.now @ now + step.before @ before + gust
    at = {n: i for i, n in enumerate(naming.names(model.State))}
    outputs = {n: states[:, at[n]] + sd * rng.standard_normal(N) for n, sd in NOISE.items()}
    inputs = dict(zip(naming.names(model.Inputs), sticks.T, strict=True))
    return Flight(dt=DT, inputs=inputs, outputs=outputs, name=f"r50-{seed}")


def _random_steps(rng: np.random.Generator, N: int) -> np.ndarray:
    lengths = rng.integers(10, 76, N // 10 + 1)
    return STICK * np.repeat(rng.uniform(-1, 1, lengths.size), lengths)[:N]


def problem(
    flights: list[Flight],
    factors: dict[str, float] | None = None,
    taus: bool = True,
    fixed: tuple[str, ...] = FIXED,
) -> Problem:
    """Return a problem with 33 derivatives, the turbulence and the measurement noise.

    Args:
        flights: the records.
        factors: factors of the starts, by parameter; 1 starts at the truth.
        taus: True to estimate the correlation times too.
        fixed: known parameters.
    """
    values, factors = naming.asdict(truth()), factors or {}
    starts = {n: float(v) * factors.get(n, 1.0) for n, v in values.items()}
    known = {*fixed, "sigma_w", "tau_w"} | (set() if taus else {_tau(a) for a in AXES})
    # sigma_w and tau_w are always unknowns; they start at the vehicle's values.
    own = {n: np.float64(starts[n]) for n in ("sigma_w", *(["tau_w"] if taus else []))}
    start = turbulent().Params(**values | own)
    free = {n: Free(v) for n, v in starts.items() if n not in known}
    return Problem(
        turbulent(),
        start,
        flights,
        free,
        Nuisance(initial_state=False, bias=False),
        method="filter-error",
        fixed_noise=() if taus else ("tau_w",),
    )


if __name__ == "__main__":
    print(__doc__, "\nA part of the scripts beside it: by itself it does nothing.")
