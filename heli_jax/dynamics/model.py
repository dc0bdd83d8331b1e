"""Model: how dynamics, ours or anyone's, reach simulation, identification and report."""

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
"""relative misfit above which a model is not linear: rounding leaves less"""


class Axis(NamedTuple):
    """An axis that a vehicle turns about, by the names of what a model has of it."""

    name: str
    """such as 'roll'"""
    rate: str
    """the state whose derivative is the angular acceleration; a disturbance adds to it"""
    angle: str | None = None
    """the state whose derivative is the rate"""
    inertia: str | None = None
    """the parameter, kg m^2"""
    added_inertia: str | None = None
    """the parameter that is known and added to it, kg m^2"""
    stick: str | None = None
    """the input that turns the vehicle about this axis"""
    flybar: tuple[str, ...] = ()
    """the states of the flybar that belong to it"""
    tilt: tuple[str, ...] = ()
    """the states of the main rotor's tip-path plane that belong to it"""


class Disturbance(NamedTuple):
    """A random push on the derivative of one state, by the names of what a model has of it."""

    name: str
    """as it was asked for: an axis or a state"""
    state: str
    """whose derivative it adds to"""
    sigma: str
    """the parameter that is its standard deviation"""
    tau: str
    """the parameter that is its correlation time [s]"""
    lags: tuple[str, ...] = ()
    """its own states, the one that is driven by white noise first"""


class LowPass(NamedTuple):
    """Sensor noise at the input of the low-passes that have filtered an output."""

    output: str
    """whose filters they are"""
    state: str
    """on whose derivative white noise before the first of them acts"""
    intensity: float
    """square root of its spectral density there, per unit of its standard deviation behind all of
    them [1/sqrt(s), for a rate's state 1/s more]"""
    hz: float
    """where they are 3 dB down together"""


class SteadyFlight(NamedTuple):
    """Unknowns and equations of trim by name, as many of the one as of the other."""

    unknowns: tuple[str, ...]
    """states, then inputs"""
    equations: tuple[str, ...]
    """states whose derivatives have to be zero"""


class Model(eqx.Module):
    r"""Pure dynamics $\dot x = f(p, x, u)$, $y = h(p, x, u)$ of one vehicle, with named parts.

    `Params`, `State`, `Inputs` and `Outputs` are classes built by keyword with one scalar a field
    (an `eqx.Module` or a `NamedTuple`; see `heli_jax.naming` for units). `vector_field` returns a
    `State` of derivatives per second. Nothing here knows about batches: use `jax.vmap`.

    `linear=True` says that `vector_field` and `output` are linear in (state, inputs) and vanish
    where both do; the exact zero-order-hold discretisation may then be used, with matrices taken
    by differentiation.

    `axes`, `steady_flight` and `without_stand` are what a model knows of itself beside its
    equations. A model that leaves them out has what its names say: see `axes_of`.
    """

    # All static: a model is what is compiled, and its numbers are parameters. Two models are the
    # same program where they have the same functions and classes, so these are made once and kept.
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
    """noise_intensity(params): a State of the square roots of the process noise's spectral
    densities, in units of the state's rate times sqrt(s)"""
    initial_sd: Callable[[Any], dict[str, Any]] | None = eqx.field(static=True, default=None)
    """initial_sd(params): standard deviation at the first sample (the square roots of the diagonal
    of P0) of the states that are random there, by name; the others begin where `start` puts them"""
    correlation: Callable[[Any], dict[tuple[str, str], Any]] | None = eqx.field(
        static=True, default=None
    )
    """correlation(params): at the first sample, between two of the states that `initial_sd` names,
    by pair of names; what is not named is uncorrelated"""
    limits: Callable[[Any, Any, Any], dict[str, Any]] | None = eqx.field(static=True, default=None)
    """limits(params, state, inputs): by name, whether the range of validity is left there"""
    axes: tuple[Axis, ...] | None = eqx.field(static=True, default=None)
    """the axes it turns about; None: by the names of its states"""
    steady_flight: SteadyFlight | None = eqx.field(static=True, default=None)
    """what trim solves for; None: by the names of its states and inputs, where it can fly"""
    without_stand: "Model | None" = eqx.field(static=True, default=None)
    """of a vehicle on a stand, the same vehicle in free flight"""
    within: "tuple[Model, Callable[[Model], Model]] | None" = eqx.field(static=True, default=None)
    """of a model with sensors that show derivatives (`with_motion_sensors`), the model within, and
    what puts its devices around another one"""
    delays: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    """inputs that act late, each with the parameter that is its delay [s]"""
    delay_lines: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    """inputs and outputs that are late by states of the model (`with_delays`), each with the
    parameter that is its delay [s]"""
    positive: tuple[str, ...] = eqx.field(static=True, default=())
    """the parameters that are above zero whatever else may change its sign"""
    fastest: float = eqx.field(static=True, default=0.0, kw_only=True)
    """of a model with filters of fixed constants the rate of the fastest [rad/s], which fixed steps
    have to follow"""
    explicit: bool = eqx.field(static=True, default=False, kw_only=True)
    """whether no mode of it is fast against the samples of a log, as of kinematics: a filter may
    then go by explicit steps"""
    input_scales: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    """the scale errors of sensors whose readings are inputs, of which the noise is process noise:
    `noise_intensity` is that of the readings over 1 + scale. Filter error keeps them unbiased"""
    disturbances: tuple[Disturbance, ...] = eqx.field(static=True, default=(), kw_only=True)
    """what `with_disturbance` added; filter error estimates its parameters by itself"""
    low_passes: tuple[LowPass, ...] = eqx.field(static=True, default=(), kw_only=True)
    """of the outputs that `with_filters` low-passes where their sensors' noise comes in"""
    body_rates: Callable[[Any], dict[str, Any]] | None = eqx.field(
        static=True, default=None, kw_only=True
    )
    """body_rates(state): the rates p, q and r of the body [rad/s] by name, where the axes' rates
    are derivatives of Euler angles; None: the axes' rates are those of the body"""

    def __reduce__(self) -> tuple[Any, ...]:
        return by_value(self)

    def __repr__(self) -> str:
        """One line: its functions say nothing that their names do not."""
        kinds = (("inputs", self.Inputs), ("states", self.State), ("outputs", self.Outputs))
        return f"Model {self.name}: " + "; ".join(
            f"{kind} {', '.join(naming.names(record))}" for kind, record in kinds
        )

    @property
    def delay_parameters(self) -> tuple[str, ...]:
        """The parameters that are delays of inputs or outputs."""
        # Several inputs may share a delay, as all sticks share the radio: it is one unknown, named
        # once.
        return tuple(dict.fromkeys(name for _, name in (*self.delays, *self.delay_lines)))

    @property
    def random_states(self) -> tuple[str, ...]:
        """The states that are random at the first sample."""
        if self.initial_sd is None:
            return ()
        # Names alone are asked for, and they may not depend on parameters: any numbers will do.
        return tuple(self.initial_sd(self.Params(**dict.fromkeys(naming.names(self.Params), 1.0))))

    def initial_state(self, params: Record) -> Record:
        """The state at the first sample: `start(params)`, or all zeros."""
        if self.start is not None:
            return self.start(params)
        return zeros(self.State)


def zeros(record: type, dtype: DTypeLike | None = None) -> Record:
    """A record of scalar zeros of the default float type (or `dtype`)."""
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
# Yaw has no added inertia: the stand has springs and weights about roll and pitch alone.
YAW = Axis("yaw", "dpsi", "psi", "Izz", None, "x_yaw")
"""The axes under the names that they have in the models here."""


def axes_of(model: Model) -> tuple[Axis, ...]:
    """The axes that a model turns about: those that it states, else those of roll, pitch and yaw
    whose rate is among its states under the name that it has in the models here."""
    if model.axes is not None:
        return model.axes
    # A model of one's own that names its states as here gets disturbances and the stand for
    # nothing; one with other names states its axes.
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
    """The standard deviations (n,) of all states at the first sample; zero where not random."""
    # Zero where a state is not named: its first value is then known, or an unknown of the fit, and
    # not something that the filter may correct.
    random = model.initial_sd(params) if model.initial_sd is not None else {}
    states = naming.names(model.State)
    return naming.ravel(model.State(**{n: random.get(n, 0.0) for n in states}), dtype)


def correlation_of(model: Model, params: Record, dtype: DTypeLike) -> Array:
    """The correlation matrix (n, n) of all states at the first sample.

    Raises:
        ValueError: the model correlates a state that is not random there.
    """
    names, random = naming.names(model.State), model.random_states
    matrix = jnp.eye(len(names), dtype=dtype)
    pairs = model.correlation(params) if model.correlation is not None else {}
    for pair, value in pairs.items():
        # A correlation with a state that is known would be lost without a word: its sd is zero.
        if not set(pair) <= set(random):
            raise ValueError(
                f"model {model.name}: correlation of {' and '.join(pair)}: expected two of the "
                f"states that initial_sd names ({', '.join(random) or 'none'})"
            )
        i, j = (names.index(n) for n in pair)
        value = jnp.asarray(value, dtype)
        matrix = matrix.at[i, j].set(value).at[j, i].set(value)
    return matrix


def linear_misfit(model: Model, params: Record) -> float:
    """Return the distance of a model from `linear=True`: 0 if f(x, u) and h(x, u) are linear, else
    about 1.

    Compares f and h at two states with the sum of both, relative to their size. Concrete
    parameters only.
    """
    # A seed of its own: the answer must not depend on who drew before.
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
        # Superposition at one random pair, which hardly any nonlinear formula passes by chance.
        summed = both(jax.tree.map(np.add, x1, x2), jax.tree.map(np.add, u1, u2))
        parts = both(x1, u1) + both(x2, u2)
        size = np.max(np.abs(summed)) + np.max(np.abs(parts))
        # The sum of the parts is compared, so an offset (gravity, say) shows as well as a curve.
        return float(np.max(np.abs(summed - parts)) / max(size, 1e-300))


def require_linear(model: Model, params: Record) -> None:
    """Refuse a model that says it is linear and is not: it would be discretised exactly, and be
    wrong without any sign of it.

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
    """The model's rates and outputs at one point."""
    return (
        model.vector_field(params, state, inputs),
        model.output(params, state, inputs),
    )


def plain(record: Record, **changes: Any) -> Record:
    """A record of concrete numbers, some of them changed, as NumPy scalars: quicker than JAX
    outside jit."""
    values = {n: np.float64(v) for n, v in {**naming.asdict(record), **changes}.items()}
    if isinstance(record, tuple):
        return type(record)(**values)
    # Past the class, which may make arrays of them (Helicopter does).
    made = copy.copy(record)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def needed_but_missing(model: Model, params: Record) -> list[str]:
    """The parameters that are NaN (not given) and that the model reads, in field order."""
    # NaN goes through every operation that uses it: what the model reads shows at the end. One that
    # may be left out (c_paddle) has another in its place by jnp.where, and does not show.
    params = plain(params)
    # Each missing one by itself, with the others at one: several NaN at a time would not say which
    # of them was read.
    missing = [n for n, v in naming.asdict(params).items() if np.isnan(v)]
    # The delay of an input is in no equation, since it acts on the record: no NaN comes through,
    # and it is known to be read by its name.
    late = dict(model.delays).values()
    return [n for n in missing if n in late or np.isnan(_at_one(model, params, n, np.nan)).any()]


def require_constants(model: Model, params: Record, given: Collection[str] = ()) -> None:
    """Refuse parameters that lack what the model reads.

    Args:
        params: the model's Params; concrete numbers, NaN where not given.

    Raises:
        VehicleError: one is missing.
    """
    missing = [n for n in needed_but_missing(model, params) if n not in given]
    if missing:
        it = "it" if len(missing) == 1 else "them"
        raise VehicleError(f"{', '.join(missing)} missing, model {model.name} needs {it}")


def reads(model: Model, params: Record, name: str) -> bool:
    """True if the rates or the outputs depend on a parameter, at states and inputs of one, or an
    input is delayed by it.

    Args:
        params: the model's Params; concrete numbers.
    """
    if name in dict(model.delays).values():
        return True
    if np.isnan(_at_one(model, params, name, np.nan)).any():
        return True
    # One that may be left out has another in its place where it is NaN.
    at_one, at_two = (_at_one(model, params, name, value) for value in (1.0, 2.0))
    return not np.array_equal(at_one, at_two, equal_nan=True)


def _at_one(model: Model, params: Record, name: str, value: float) -> np.ndarray:
    """Rates and outputs where states, inputs and what is not given are one, and a parameter is
    `value`."""
    # One and not zero: a parameter that multiplies a state or another parameter must show.
    one = np.float64(1.0)
    others = {n: one for n, v in naming.asdict(params).items() if np.isnan(v)}
    filled = plain(params, **{**others, name: value})
    x = model.State(**dict.fromkeys(naming.names(model.State), one))
    u = model.Inputs(**dict.fromkeys(naming.names(model.Inputs), one))
    with np.errstate(all="ignore"):
        parts = field_and_output(model, filled, x, u)
    return np.array([float(v) for v in jax.tree.leaves(parts)])
