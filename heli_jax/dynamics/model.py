"""Model: the interface between dynamics and simulation, identification and report."""

import copy
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.errors import VehicleError
from heli_jax.naming import Record
from heli_jax.pickled import by_value

_LINEAR = 1e-6
"""Largest relative deviation of a linear model; rounding gives less."""


class Axis(NamedTuple):
    """A rotation axis of a vehicle, by the names of its parts in the model."""

    name: str
    """Name, such as 'roll'."""
    rate: str
    """State whose derivative is the angular acceleration; a disturbance adds to it."""
    angle: str | None = None
    """State whose derivative is the rate."""
    inertia: str | None = None
    """Parameter for the inertia [kg m^2]."""
    added_inertia: str | None = None
    """Parameter for a known inertia that is added [kg m^2]."""
    stick: str | None = None
    """Input that turns the vehicle about this axis."""
    flybar: tuple[str, ...] = ()
    """States of the flybar for this axis."""
    tilt: tuple[str, ...] = ()
    """States of the main rotor's tip-path plane for this axis."""


class Disturbance(NamedTuple):
    """A random disturbance of one state's derivative, by the names of its parts in the model."""

    name: str
    """Requested name: an axis or a state."""
    state: str
    """State whose derivative is disturbed."""
    sigma: str
    """Parameter for its standard deviation."""
    tau: str
    """Parameter for its correlation time [s]."""
    lags: tuple[str, ...] = ()
    """Its own states; white noise drives the first."""


class LowPass(NamedTuple):
    """Sensor noise at the input of the low-passes of an output."""

    output: str
    """Filtered output."""
    state: str
    """State whose derivative the white noise before the first filter drives."""
    intensity: float
    """Square root of its spectral density there, per unit of sd after all filters [1/sqrt(s); for a
    rate's state, times 1/s].
    """
    hz: float
    """Joint -3 dB frequency of the filters [Hz]."""


class SteadyFlight(NamedTuple):
    """Unknowns and equations of trim by name, in equal number."""

    unknowns: tuple[str, ...]
    """Unknown states, then unknown inputs."""
    equations: tuple[str, ...]
    """States whose derivatives must be zero."""


class Sampled(NamedTuple):
    """A change of the state at every sample."""

    dt: float
    """Sample time [s]."""
    update: Callable[[Any, Any, Any], Any]
    """update(params, state, inputs): the State after a controller's step."""
    plant: "Model"
    """The model without controller."""
    hold: Callable[[Any, Any, Any], tuple[Any, Any]]
    """hold(params, state, inputs): State and Inputs of the closed loop that hold a steady flight of
    the plant, with a command of zero."""


class Model(eqx.Module):
    r"""Dynamics $\dot x = f(p, x, u)$, $y = h(p, x, u)$ of one vehicle, with named parts.

    `Params`, `State`, `Inputs` and `Outputs` are classes built by keyword with one scalar a field
    (an `eqx.Module` or a `NamedTuple`; see `heli_jax.naming` for units). `vector_field` returns a
    `State` of derivatives per second. For batches use `jax.vmap`.

    `linear=True` states that `vector_field` and `output` are linear in (state, inputs) and zero at
    zero. Discretisation is then exact, with matrices from differentiation.

    `axes` and `steady_flight` are optional. By default they follow from the names of states and
    inputs: see `axes_of`.
    """

    # All fields are static, since a model is compiled and its numbers are parameters. Models with
    # the same functions and classes are the same program, so these are created once.
    name: str = eqx.field(static=True)
    vector_field: Callable[[Any, Any, Any], Any] = eqx.field(static=True)
    output: Callable[[Any, Any, Any], Any] = eqx.field(static=True)
    Params: type = eqx.field(static=True)
    State: type = eqx.field(static=True)
    Inputs: type = eqx.field(static=True)
    Outputs: type = eqx.field(static=True)
    linear: bool = eqx.field(static=True, default=False)
    start: Callable[[Any], Any] | None = eqx.field(static=True, default=None)
    noise_intensity: Callable[[Any], Any] | None = eqx.field(static=True, default=None)
    """noise_intensity(params): a State with the square roots of the process noise's spectral
    densities, in units of the state's rate times sqrt(s).
    """
    initial_sd: Callable[[Any], dict[str, Any]] | None = eqx.field(static=True, default=None)
    """initial_sd(params): standard deviations of random initial states by name (square roots of the
    diagonal of P0). Other states start at `start`.
    """
    correlation: Callable[[Any], dict[tuple[str, str], Any]] | None = eqx.field(
        static=True, default=None
    )
    """correlation(params): correlations of initial states in `initial_sd`, by pair of names; other
    pairs are uncorrelated.
    """
    limits: Callable[[Any, Any, Any], dict[str, Any]] | None = eqx.field(static=True, default=None)
    """limits(params, state, inputs): by name, True outside the range of validity."""
    axes: tuple[Axis, ...] | None = eqx.field(static=True, default=None)
    """Axes of rotation; None: from the names of the states."""
    steady_flight: SteadyFlight | None = eqx.field(static=True, default=None)
    """Unknowns and equations of trim; None: from the names of states and inputs, if it can fly."""
    within: "tuple[Model, Callable[[Model], Model]] | None" = eqx.field(static=True, default=None)
    """For a model with sensors of derivatives (`with_motion_sensors`): the inner model, and the
    function that adds its devices to another model.
    """
    delays: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    """Delayed inputs, each with the parameter of its delay [s]."""
    delay_lines: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    """Inputs and outputs delayed by states of the model (`with_delays`), each with the parameter of
    its delay [s].
    """
    positive: tuple[str, ...] = eqx.field(static=True, default=())
    """Parameters that are always above zero."""
    fastest: float = eqx.field(static=True, default=0.0, kw_only=True)
    """Rate of the fastest filter with fixed constants [rad/s], which fixed steps must resolve."""
    explicit: bool = eqx.field(static=True, default=False, kw_only=True)
    """True if no mode is fast compared with the samples, as in kinematics. A filter may then take
    explicit steps.
    """
    input_scales: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    """Scale errors of sensors whose readings are inputs with process noise. `noise_intensity` is
    that of the readings over 1 + scale. Filter error estimates them without bias.
    """
    disturbances: tuple[Disturbance, ...] = eqx.field(static=True, default=(), kw_only=True)
    """Disturbances added by `with_disturbance`; filter error estimates their parameters."""
    low_passes: tuple[LowPass, ...] = eqx.field(static=True, default=(), kw_only=True)
    """For outputs with low-passes from `with_filters`: the inputs of sensor noise."""
    body_rates: Callable[[Any], dict[str, Any]] | None = eqx.field(
        static=True, default=None, kw_only=True
    )
    """body_rates(state): body rates p, q and r [rad/s] by name, if the axes' rates are derivatives
    of Euler angles; None: the axes' rates are body rates.
    """
    sampled: Sampled | None = eqx.field(static=True, default=None, kw_only=True)
    """Step of a controller at each sample (`with_controller`); None without one."""

    def __reduce__(self) -> tuple[Any, ...]:
        return by_value(self)

    def __repr__(self) -> str:
        """Return one line with the names of inputs, states and outputs."""
        kinds = (("inputs", self.Inputs), ("states", self.State), ("outputs", self.Outputs))
        return f"Model {self.name}: " + "; ".join(
            f"{kind} {', '.join(naming.names(record))}" for kind, record in kinds
        )

    @property
    def delay_parameters(self) -> tuple[str, ...]:
        """Return the parameters that are delays of inputs or outputs."""
        # Several inputs may share a delay, as all sticks share the radio. It is then one unknown.
        return tuple(dict.fromkeys(name for _, name in (*self.delays, *self.delay_lines)))

    @property
    def random_states(self) -> tuple[str, ...]:
        """Return the states that are random at the first sample."""
        if self.initial_sd is None:
            return ()
        # The names do not depend on parameters, so any values serve.
        return tuple(self.initial_sd(self.Params(**dict.fromkeys(naming.names(self.Params), 1.0))))

    def initial_state(self, params: Record) -> Record:
        """Return the state at the first sample: `start(params)`, or zeros."""
        if self.start is not None:
            return self.start(params)
        return zeros(self.State)


def zeros(record: type, dtype: DTypeLike | None = None) -> Record:
    """Return a record of scalar zeros of the default float type (or `dtype`)."""
    dtype = jnp.result_type(float) if dtype is None else dtype
    return record(**{name: jnp.zeros((), dtype) for name in naming.names(record)})


ROLL = Axis(
    "roll", "dphi", "phi", "Ixx", "Ixx_added", "x_roll", ("beta_roll", "dbeta_roll"), ("b1",)
)
PITCH = Axis(
    "pitch",
    "dtheta",
    "theta",
    "Iyy",
    "Iyy_added",
    "x_pitch",
    ("beta_pitch", "dbeta_pitch"),
    ("a1",),
)
# Yaw has no added inertia, since the stand acts only on roll and pitch.
YAW = Axis("yaw", "dpsi", "psi", "Izz", None, "x_yaw")
"""Axes, with the names used in this package's models."""


def axes_of(model: Model) -> tuple[Axis, ...]:
    """Return the axes that a model states, else roll, pitch and yaw with a known rate as state."""
    if model.axes is not None:
        return model.axes
    # A user's model with the same state names needs no axes to have disturbances and the stand.
    states = naming.names(model.State)
    return tuple(
        axis._replace(
            angle=axis.angle if axis.angle in states else None,
            flybar=tuple(n for n in axis.flybar if n in states),
            tilt=tuple(n for n in axis.tilt if n in states),
        )
        for axis in (ROLL, PITCH, YAW)
        if axis.rate in states
    )


def initial_sd_of(model: Model, params: Record, dtype: DTypeLike) -> Float[Array, " n"]:
    """Return the standard deviations (n,) of all states at the first sample; zero if not random."""
    # Zero for other states: their first value is known or estimated, and the filter must not
    # correct it.
    random = model.initial_sd(params) if model.initial_sd is not None else {}
    states = naming.names(model.State)
    return naming.ravel(model.State(**{n: random.get(n, 0.0) for n in states}), dtype)


def correlation_of(model: Model, params: Record, dtype: DTypeLike) -> Array:
    """Return the correlation matrix (n, n) of all states at the first sample.

    Raises:
        ValueError: the model correlates a state that is not random there.
    """
    names, random = naming.names(model.State), model.random_states
    matrix = jnp.eye(len(names), dtype=dtype)
    pairs = model.correlation(params) if model.correlation is not None else {}
    for pair, value in pairs.items():
        # A correlation with a known state would silently have no effect, since its sd is zero.
        if not set(pair) <= set(random):
            raise ValueError(
                f"model {model.name}: correlation of {' and '.join(pair)}: expected two of the "
                f"states in initial_sd ({', '.join(random) or 'none'})"
            )
        i, j = (names.index(n) for n in pair)
        value = jnp.asarray(value, dtype)
        matrix = matrix.at[i, j].set(value).at[j, i].set(value)
    return matrix


def linear_misfit(model: Model, params: Record) -> float:
    """Return the deviation of a model from linearity: 0 if f(x, u) and h(x, u) are linear, else
    about 1.

    It compares the sum of f and h at two states with their values at the sum, relative to their
    size. Parameters must be concrete.
    """
    # A fixed seed makes the result reproducible.
    rng = np.random.default_rng(7)

    def draw(record: type) -> Record:
        return record(**{n: np.float64(rng.standard_normal()) for n in naming.names(record)})

    def both(state: Record, inputs: Record) -> np.ndarray:
        with np.errstate(all="ignore"):
            rates, outputs = field_and_output(model, params, state, inputs)
        return np.array([float(v) for v in jax.tree.leaves((rates, outputs))])

    params = plain(params)
    x1, x2, u1, u2 = draw(model.State), draw(model.State), draw(model.Inputs), draw(model.Inputs)
    with np.errstate(all="ignore"):
        # Superposition at one random pair, which a nonlinear formula hardly satisfies by chance.
        summed = both(jax.tree.map(np.add, x1, x2), jax.tree.map(np.add, u1, u2))
        parts = both(x1, u1) + both(x2, u2)
        size = np.max(np.abs(summed)) + np.max(np.abs(parts))
        # The sum of the parts is compared, so an offset such as gravity shows as well as curvature.
        return float(np.max(np.abs(summed - parts)) / max(size, 1e-300))


def require_continuous(model: Model, purpose: str) -> None:
    """Raise if a model contains a controller, which acts at samples.

    Raises:
        ValueError: with the purpose.
    """
    if model.sampled is not None:
        raise ValueError(f"{purpose}: expected the model without its controller, got {model.name}")


def require_linear(model: Model, params: Record) -> None:
    """Raise if a model with `linear=True` is nonlinear, since its discretisation would be wrong.

    Args:
        params: the model's Params, SI, concrete.

    Raises:
        ValueError: its vector field or output is not linear in state and inputs there.
    """
    if model.linear and linear_misfit(model, params) > _LINEAR:
        raise ValueError(
            f"model {model.name} says linear=True, but its vector field or output is not linear in "
            "state and inputs with these parameters; expected linear=False"
        )


def field_and_output(
    model: Model, params: Record, state: Record, inputs: Record
) -> tuple[Any, Any]:
    """Return the model's rates and outputs at one point."""
    return (
        model.vector_field(params, state, inputs),
        model.output(params, state, inputs),
    )


def plain(record: Record, **changes: Any) -> Record:
    """Return a record as NumPy scalars, with some fields changed; this is faster than JAX outside
    jit.
    """
    values = {n: np.float64(v) for n, v in {**naming.asdict(record), **changes}.items()}
    if isinstance(record, tuple):
        return type(record)(**values)
    # Bypass the class, which may convert values to arrays (Helicopter does).
    made = copy.copy(record)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def missing_parameters(model: Model, params: Record) -> list[str]:
    """Return the parameters that the model reads and that are NaN (not given), in field order."""
    # NaN propagates through every operation, so it marks the parameters that are read. An optional
    # one (c_paddle) is replaced by jnp.where and does not show.
    params = plain(params)
    # Test each missing parameter alone, with the others at one. With several NaN the source would
    # be unclear.
    missing = [n for n, v in naming.asdict(params).items() if np.isnan(v)]
    # An input's delay is in no equation, so NaN does not reveal it. It is found by name.
    late = dict(model.delays).values()
    return [n for n in missing if n in late or np.isnan(_at_one(model, params, n, np.nan)).any()]


def require_constants(model: Model, params: Record, given: Collection[str] = ()) -> None:
    """Refuse parameters that lack values the model reads.

    Args:
        params: the model's Params; concrete numbers, NaN where not given.

    Raises:
        VehicleError: one is missing.
    """
    missing = [n for n in missing_parameters(model, params) if n not in given]
    if missing:
        it = "it" if len(missing) == 1 else "them"
        raise VehicleError(f"{', '.join(missing)} missing, model {model.name} needs {it}")


def require_sample_time(model: Model, dt: Any, where: str = "dt") -> None:
    """Refuse a sample time [s] at which the model's controller does not act.

    Raises:
        ValueError: with both times.
    """
    if model.sampled is not None and not np.allclose(dt, model.sampled.dt, rtol=1e-6, atol=0.0):
        raise ValueError(
            f"{where}: expected a sample time of {model.sampled.dt:g} s, that of the controller, "
            f"got {float(np.ravel(dt)[0]):g} s"
        )


def reads(model: Model, params: Record, name: str) -> bool:
    """True if rates or outputs depend on a parameter (states and inputs one), or it is a delay.

    Args:
        params: the model's Params; concrete numbers.
    """
    if name in dict(model.delays).values():
        return True
    if np.isnan(_at_one(model, params, name, np.nan)).any():
        return True
    # An optional parameter is replaced by another if it is NaN.
    at_one, at_two = (_at_one(model, params, name, value) for value in (1.0, 2.0))
    return not np.array_equal(at_one, at_two, equal_nan=True)


def vehicle_constants(model: Model) -> dict[str, float]:
    """Return the constants that a vehicle may have, with defaults; NaN where it must state one."""
    defaults, known = naming.defaults(model.Params), naming.names(model.Params)
    # Any number replaces required ones: it only shows which constants the model reads.
    params = model.Params(**{n: defaults.get(n, 1.0) for n in known})
    needed = {*(n for n in known if n not in defaults), *missing_parameters(model, params)}
    values = dict.fromkeys(needed, np.nan)
    for name in known:
        value = float(getattr(params, name))
        if name not in needed and np.isfinite(value) and reads(model, params, name):
            values[name] = value
    return {n: values[n] for n in known if n in values}


def _at_one(model: Model, params: Record, name: str, value: float) -> np.ndarray:
    """Return rates and outputs with a parameter at `value`; states, inputs and missing ones are
    1.
    """
    # One instead of zero, so that a parameter that multiplies a state or another parameter shows.
    one = np.float64(1.0)
    others = {n: one for n, v in naming.asdict(params).items() if np.isnan(v)}
    filled = plain(params, **{**others, name: value})
    x = model.State(**dict.fromkeys(naming.names(model.State), one))
    u = model.Inputs(**dict.fromkeys(naming.names(model.Inputs), one))
    with np.errstate(all="ignore"):
        parts = field_and_output(model, filled, x, u)
        if model.sampled is not None:
            parts = (*parts, model.sampled.update(filled, x, u))
    return np.array([float(v) for v in jax.tree.leaves(parts)])
