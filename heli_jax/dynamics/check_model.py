"""Checks that an object is a model that JAX can trace, before any computation.

A model's functions are called with tracers, which represent unknown numbers. NumPy's functions, `if
x > 0` and `float(x)` fail on tracers.

Names in a model (delays, axes, positive parameters) must exist. Python does not check them: a wrong
axis would be ignored, and a wrong delay would fail during a fit.

`cannot_start` checks that a model can start at its initial state, and `starting_at` changes that
state.
"""

import dataclasses
import functools
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array

from heli_jax import naming, units
from heli_jax.dynamics.model import Axis, Model, field_and_output, plain
from heli_jax.errors import nearest
from heli_jax.naming import Record

_RECORDS = ("Params", "State", "Inputs", "Outputs")


# Any: arguments and return values of users' functions can have any type.


def check_params(params: type, vehicle: Any) -> None:
    """Refuse an object without the parameters of a model.

    Raises:
        TypeError: the object has other parameters; the message states what to pass.
    """
    if isinstance(vehicle, str | bytes) or hasattr(vehicle, "__fspath__"):
        raise TypeError(
            f"vehicle: expected {params.__name__}, got a path; "
            "heli_jax.load_vehicle(path, model.Params) reads the file"
        )
    if not all(hasattr(vehicle, name) for name in naming.names(params)):
        raise TypeError(
            f"vehicle: expected the model's {params.__name__}, got {type(vehicle).__name__}; "
            "model.Params(**heli_jax.naming.asdict(vehicle), NAME=value) adds what is missing"
        )


def check_model(model: Any, *, traceable: bool = True) -> None:
    """Raise if an object is not a Model, or its functions fail or return unexpected types.

    A model is checked once; later calls look it up.

    Args:
        traceable: True if parameters, states and inputs are all traced, as in a fit or a sweep.
            Otherwise only return values are checked, since code may branch on plain parameters.

    Raises:
        TypeError: it is not a Model.
        ValueError: a function fails; the message gives its name, what was expected, and the remedy.
    """
    if isinstance(model, str):
        raise TypeError(
            "model: expected a heli_jax.Model, from heli_jax.models.by_name or "
            f"heli_jax.linear_model, got the name {model!r:.60}"
        )
    if not isinstance(model, Model):
        raise TypeError(
            "model: expected a heli_jax.Model, made by Model(name, vector_field, output, Params, "
            f"State, Inputs, Outputs), got {description_of(model)}"
        )
    # Models of this package are tested, and wrapped functions were checked when they were wrapped.
    if str(getattr(_bare(model.vector_field), "__module__", "")).startswith("heli_jax."):
        return
    parts = _Parts(*(getattr(model, name) for name in _Parts._fields))
    # Each set of functions and classes is traced once, not in every call of `simulate`.
    try:
        hash(parts)
    except TypeError:  # such as a function that holds arrays
        _check(parts, traceable)
    else:
        _check_once(parts, traceable)


def description_of(value: Any) -> str:
    """Describe an object that is no Model, for the end of a message."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    function = _bare(value)
    # The function is not called, since a user's function may have side effects.
    if getattr(function, "__annotations__", {}).get("return") in (Model, "Model"):
        name = function.__name__
        return f"the function {name}, which makes one; expected its result, {name}()"
    return _kind(value)


class _Parts(NamedTuple):
    """Functions and classes of a Model, which identify it in the cache."""

    name: str
    vector_field: Any
    output: Any
    Params: Any
    State: Any
    Inputs: Any
    Outputs: Any
    start: Any
    noise_intensity: Any
    initial_sd: Any
    limits: Any
    delays: Any
    axes: Any
    positive: Any
    body_rates: Any


@functools.lru_cache(maxsize=256)
def _check_once(parts: _Parts, traceable: bool) -> None:
    _check(parts, traceable)


def explained[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of a model, so that errors caused by the model are those of
    `check_model`.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        model = args[0] if args else kwargs.get("model")
        check_model(model, traceable=False)
        # It is not known in advance whether all arguments are traced. The full check therefore runs
        # only after a failure. If it finds nothing, the model did not cause the failure.
        try:
            return function(*args, **kwargs)
        except Exception:
            check_model(model)
            raise

    return wrapper


def _check(model: _Parts, traceable: bool) -> None:
    # Classes first, since functions are traced with their records.
    for role in _RECORDS:
        _check_record(model, role)
    check_names(model)

    def of(role: str, *arguments: str) -> _Function:
        return _Function(model, role, arguments, traceable)

    of("vector_field", "params", "state", "inputs").returns("State")
    of("output", "params", "state", "inputs").returns("Outputs")
    if model.start is not None:
        of("start", "params").returns("State")
    if model.noise_intensity is not None:
        of("noise_intensity", "params").returns("State")
    if model.initial_sd is not None:
        of("initial_sd", "params").returns_by_name(naming.names(model.State))
    if model.body_rates is not None:
        of("body_rates", "state").returns_by_name(("p", "q", "r"))
    if model.limits is not None:
        of("limits", "params", "state", "inputs").returns_by_name(None)


def _check_record(model: _Parts, role: str) -> None:
    """Refuse a class of parameters, states, ... that cannot be built by keyword."""
    record = getattr(model, role)
    expected = "expected a class with one number per field, such as a NamedTuple"
    if not isinstance(record, type):
        raise ValueError(f"model {model.name!r}: {role}: {expected}, got {_kind(record)}")
    try:
        names = naming.names(record)
    except Exception as e:
        words = " ".join(str(e).split())[:200]
        raise ValueError(
            f"model {model.name!r}: {role}: {expected}, got {record.__name__}, whose fields are "
            f"unknown ({type(e).__name__}: {words})"
        ) from e
    # A vehicle without inputs may fall, but one without states has nothing to integrate.
    if not names and role != "Inputs":
        raise ValueError(f"model {model.name!r}: {role}: {expected}, got one without fields")
    if _is_leaf(record, names):
        raise ValueError(
            f"model {model.name!r}: {role}: {expected} or an eqx.Module, got {record.__name__}, "
            "which is no pytree; @jax.tree_util.register_dataclass makes one of a dataclass"
        )


def _is_leaf(record: type, names: tuple[str, ...]) -> bool:
    """True if JAX treats a record as one value instead of the values of its fields."""
    try:
        # A class that is no pytree is one opaque value, and every function would fail within jit
        # with a misleading message.
        made = record(**dict.fromkeys(names, 1.0))
    except Exception:  # a class that checks its values cannot be tested here
        return False
    return jax.tree_util.all_leaves([made])


class _Function:
    """One function of a model, with its names for messages."""

    def __init__(
        self, model: _Parts, role: str, arguments: tuple[str, ...], traceable: bool
    ) -> None:
        self.model, self.role, self.arguments = model, role, arguments
        self.traceable, self.function = traceable, getattr(model, role)
        if not callable(self.function):
            self.refuse(
                f"expected a function of ({', '.join(arguments)}), got {_kind(self.function)}"
            )

    def refuse(self, problem: str, cause: BaseException | None = None) -> None:
        where = f"model {self.model.name!r}: {self.role} {_name(self.function)}"
        raise ValueError(f"{where}{_line(self.function, cause)}: {problem}") from cause

    def returns(self, role: str) -> None:
        """Refuse a return value that is no record of that role with one number a field."""
        record = getattr(self.model, role)
        self.traced(lambda returned: self.check_fields(returned, record, role))

    def returns_by_name(self, known: tuple[str, ...] | None) -> None:
        """Refuse a return value that is no dictionary of numbers with known names."""

        def check(returned: Any) -> None:
            if not isinstance(returned, dict):
                self.refuse(f"expected a dictionary by name, got {_kind(returned)}")
            for name, value in returned.items():
                if known is not None and name not in known:
                    kind = "rates" if self.role == "body_rates" else "states"
                    self.refuse(f"expected names of {kind} ({', '.join(known)}), got {name!r}")
                self.check_number(name, value)

        self.traced(check)

    def check_fields(self, returned: Any, record: type, role: str) -> None:
        """Refuse a return value that is not a matching record."""
        fields = ", ".join(f"{n}=..." for n in naming.names(record)[:4])
        more = ", ..." if len(naming.names(record)) > 4 else ""
        expected = f"expected the model's {role}, as `return {record.__name__}({fields}{more})`"
        # Outputs may be another class with the same fields, but states are added to one another.
        alike = role == "Outputs" and all(hasattr(returned, n) for n in naming.names(record))
        if not (isinstance(returned, record) or alike):
            self.refuse(f"{expected}, got {_kind(returned)}")
        for name in naming.names(record):
            self.check_number(name, getattr(returned, name))

    def check_number(self, name: str, value: Any) -> None:
        try:
            array = jnp.asarray(value)
        except (TypeError, ValueError):
            self.refuse(f"expected a number for {name!r}, got {_kind(value)}")
            raise
        if array.shape != ():
            self.refuse(
                f"expected one number for {name!r}, got an array of shape {array.shape}; a model "
                "is written for one vehicle, jax.vmap makes many"
            )
        if not (
            jnp.issubdtype(array.dtype, jnp.floating)
            or jnp.issubdtype(array.dtype, jnp.integer)
            # Limits are booleans.
            or self.role == "limits"
        ):
            self.refuse(f"expected a real number for {name!r}, got one of type {array.dtype}")

    def traced(self, check: Callable[[Any], None]) -> None:
        """Call the function with tracers, and check the result while they exist."""
        classes = [getattr(self.model, a.capitalize()) for a in self.arguments]
        # Only shapes and types are evaluated, so a slow model costs no time.
        number = jax.ShapeDtypeStruct((), jnp.result_type(float))

        def call(numbers: list[list[Any]]) -> None:
            try:
                records = [
                    record(**dict(zip(naming.names(record), values, strict=True)))
                    for record, values in zip(classes, numbers, strict=True)
                ]
            except Exception:  # a class that checks its values cannot be tested here
                return
            try:
                returned = self.function(*records)
            except Exception as e:
                if self.traceable:
                    self.refuse(_words(e), e)
                return
            check(returned)

        jax.eval_shape(call, [[number] * len(naming.names(record)) for record in classes])


# Swapped arguments are the most common mistake, and appear as a missing attribute.
def _words(e: Exception) -> str:
    """Return the error of a function in words, with a remedy if there is one."""
    if isinstance(e, jax.errors.TracerBoolConversionError):
        return (
            "branches on a traced value (if, while, and, or, min, max); expected "
            "jnp.where(condition, a, b) or jax.lax.cond in its place"
        )
    if isinstance(e, jax.errors.TracerArrayConversionError):
        return "uses NumPy on a traced value; expected jax.numpy, as jnp.sin in place of np.sin"
    if isinstance(e, jax.errors.ConcretizationTypeError | jax.errors.TracerIntegerConversionError):
        return (
            "makes a Python number of a traced value (float, int, the functions of math, an "
            "index); expected the value itself, and jax.numpy, as jnp.sin in place of math.sin"
        )
    words = " ".join(str(e).split())[:200]
    order = ""
    if isinstance(e, AttributeError | TypeError):
        order = (
            "; the arguments are (params, state, inputs), for start and noise_intensity only params"
        )
    return f"expected a return value, got {type(e).__name__}{f' ({words})' if words else ''}{order}"


def _is_named_tuple(value: Any) -> bool:
    return isinstance(value, tuple) and hasattr(value, "_fields")


def _kind(value: Any) -> str:
    """Return the kind of a value: `a tuple of 2`, `None`, `a dict`."""
    if value is None:
        return "None"
    if isinstance(value, core.Tracer | jax.Array):
        return f"an array of shape {jnp.shape(value)}"
    if isinstance(value, tuple | list) and not _is_named_tuple(value):
        return f"a {type(value).__name__} of {len(value)}"
    name = type(value).__name__
    return f"an object of class {name}" if name[:1].isupper() else f"a {name}"


def _bare(function: Any) -> Any:
    """Return the function within partial applications and other wrappers."""
    # functools.partial has `func`, jit and functools.wraps have `__wrapped__`.
    while True:
        inner = getattr(function, "func", None) or getattr(function, "__wrapped__", None)
        if inner is None or not callable(inner):
            return function
        function = inner


def _name(function: Any) -> str:
    """Return `module.function`."""
    function = _bare(function)
    name = getattr(function, "__qualname__", type(function).__name__)
    module = getattr(function, "__module__", "")
    return f"{module}.{name}" if module else name


def _line(function: Any, cause: BaseException | None) -> str:
    """Return ` (line 12)`: the line of an error in the function's file, or its first line."""
    code = getattr(_bare(function), "__code__", None)
    if code is None:
        return ""
    line = code.co_firstlineno
    if cause is not None:
        # The deepest line in the function's own file, since deeper lines are JAX's.
        inside = [
            frame.lineno
            for frame in traceback.extract_tb(cause.__traceback__)
            if frame.filename == code.co_filename
        ]
        line = inside[-1] if inside else line
    return f" (line {line})"


# A user's model may have any values in its fields.


def check_names(model: Any) -> None:
    """Refuse delays, axes and positive parameters with names that the model lacks.

    Args:
        model: model with checked classes `Params`, `State`, `Inputs`, and with `name`, `delays`,
            `axes` and `positive`.

    Raises:
        ValueError: a name is unknown; the message states the place, what was expected and what was
            found.
    """
    _check_delays(model)
    for axis in _tuple(model, "axes", model.axes if model.axes is not None else ()):
        if not isinstance(axis, Axis):
            _refuse(model, "axes", f"expected only Axis records, got {axis!r:.60}")
        for key, role, name in _names_of(model, axis):
            _known(model, f"axes: {axis.name!s:.30}.{key}", role, name)
    for name in _tuple(model, "positive", model.positive):
        _known(model, "positive", "Params", name)


def _check_delays(model: Any) -> None:
    late = set()
    for pair in _tuple(model, "delays", model.delays):
        if not (isinstance(pair, tuple) and len(pair) == 2):
            _refuse(model, "delays", f"expected pairs (input, parameter), got {pair!r:.60}")
        stick, parameter = pair
        _known(model, "delays", "Inputs", stick)
        _known(model, f"delays of {stick}", "Params", parameter)
        # A delay is used in seconds, whatever its unit.
        unit = naming.unit(model.Params, parameter)
        if unit is not None and not _is_second(unit):
            problem = f"expected {parameter} in s, got {unit!r}"
            _refuse(model, f"delays of {stick}", problem)
        # Two delays would read one record at different times. Later code stores them by input, so
        # the second would silently replace the first.
        if stick in late:
            _refuse(model, "delays", f"expected one delay of {stick}, got two")
        late.add(stick)


def _is_second(unit: str) -> bool:
    try:
        # Milliseconds are refused too, since the value would be used as seconds, a thousand times
        # too long.
        return units.factor(unit, "s") == 1.0
    except ValueError:
        return False


def _names_of(model: Any, axis: Axis) -> Iterator[tuple[str, str, Any]]:
    """Yield (field, role, name) for all names in an axis."""
    yield "rate", "State", axis.rate
    optional = (
        ("angle", "State"), ("inertia", "Params"), ("added_inertia", "Params"), ("stick", "Inputs"),
    )  # fmt: skip
    for key, role in optional:
        if getattr(axis, key) is not None:
            yield key, role, getattr(axis, key)
    for name in _tuple(model, f"axes: {axis.name!s:.30}.flybar", axis.flybar):
        yield "flybar", "State", name


def _tuple(model: Any, place: str, value: Any) -> tuple[Any, ...]:
    """Return the value, which must be a tuple: a model is compiled, so its parts must
    not change.
    """
    # An Axis is itself a tuple: `axes=(Axis(...))` without its comma would look like a tuple of
    # names.
    if not isinstance(value, tuple) or isinstance(value, Axis):
        example = _EXAMPLES.get(place, '("c", "d")')
        _refuse(model, place, f"expected a tuple, as {example}, got {value!r:.60}")
    return value


_EXAMPLES = {
    "delays": '(("pedal", "tau_pedal"),)',
    "axes": '(Axis("roll", rate="p"),)',
    "positive": '("tau",)',
}
_KINDS = {"State": "state", "Params": "parameter", "Inputs": "input"}


def _known(model: Any, place: str, role: str, name: Any) -> None:
    known = naming.names(getattr(model, role))
    if not isinstance(name, str) or name not in known:
        problem = f"no {_KINDS[role]} {name!r:.40} in {role}{nearest(str(name), known)}"
        _refuse(model, place, problem)


def _refuse(model: Any, place: str, problem: str) -> NoReturn:
    raise ValueError(f"model {model.name!r}: {place}: {problem}")


def starting_at(model: Model, values: Mapping[str, float]) -> Model:
    """Return the model with given initial values [SI] of some states.

    Raises:
        ValueError: the model lacks a state.
    """
    for name in values:
        if name not in naming.names(model.State):
            raise ValueError(f"model {model.name} has no state {name!r}")

    def start(params: Record) -> Record:
        # The values take the dtype of the old ones, so that a float32 run stays float32.
        state = naming.asdict(model.initial_state(params))
        changed = {n: jnp.asarray(v, jnp.asarray(state[n]).dtype) for n, v in values.items()}
        return model.State(**{**state, **changed})

    return dataclasses.replace(model, start=start)


def cannot_start(model: Model, params: Record, inputs: Mapping[str, float] | None = None) -> str:
    """Return the reason why a model cannot start at its initial state, with the remedy; empty if it
    can.

    Rates and outputs must be finite there, and so must the rates' derivatives by the states.

    Args:
        params: the model's Params, SI; concrete numbers.
        inputs: inputs at the first sample; default: zero.
    """
    params = plain(params)
    names = naming.names(model.State)
    state = naming.asdict(model.initial_state(params))
    x = {n: np.float64(state[n]) for n in names}
    u = model.Inputs(
        **{n: np.float64((inputs or {}).get(n, 0.0)) for n in naming.names(model.Inputs)}
    )
    # NumPy outside jit, since one evaluation is faster than compiling.
    bad = _not_finite(model, params, x, u)
    if not bad:
        return ""
    # A model that divides by an airspeed cannot start at rest, and JAX only returns NaN. To find
    # the cause, each zero state is set to one: first alone, then all together, in case two form a
    # speed.
    zero = [n for n in names if x[n] == 0.0]
    cause = [n for n in zero if len(_not_finite(model, params, {**x, n: _ONE}, u)) < len(bad)]
    if not cause and not _not_finite(model, params, {**x, **dict.fromkeys(zero, _ONE)}, u):
        cause = zero
    verb = "is" if len(bad) == 1 else "are"
    what = f"model {model.name}: {' and '.join(bad)} {verb} not finite at the initial state"
    if not cause:
        where = ", ".join(f"{n} = {x[n]:g}" for n in names)
        return f"{what} ({where}); expected another Model.start, other parameters or inputs"
    where = ", ".join(f"{n} = 0" for n in cause)
    example = ", ".join(f"{n}: 1.0" for n in cause)
    return (
        f"{what}, where {where}; expected another Model.start, or in a configuration "
        f"initial_state: {{{example}}} with the value of the record"
    )


_ONE = np.float64(1.0)


def _not_finite(model: Model, params: Record, x: dict[str, Any], u: Record) -> tuple[str, ...]:
    """Return the rates and outputs that are not finite at a point, or have derivatives that are
    not.
    """
    with np.errstate(all="ignore"):
        rates, outputs = field_and_output(model, params, model.State(**x), u)
    values = {f"the rate of {n}": v for n, v in naming.asdict(rates).items()}
    values |= {f"output {n}": v for n, v in naming.asdict(outputs).items()}
    bad = tuple(n for n, v in values.items() if not np.isfinite(float(v)))
    # Derivatives matter only if the values are finite.
    return bad or _no_slope(model, params, x, u)


def _no_slope(model: Model, params: Record, x: dict[str, Any], u: Record) -> tuple[str, ...]:
    """Return the rates with derivatives by the states that are not finite, such as a
    root at zero.
    """

    def rates(x: Array) -> Array:
        return naming.ravel(model.vector_field(params, naming.unravel(model.State, x), u))

    # Use JAX: at rest sqrt(V2) and its finite differences are finite, but a fit's gradient is not.
    slopes = jax.jacfwd(rates)(naming.ravel(model.State(**x), jnp.result_type(float)))
    finite = np.isfinite(np.asarray(slopes)).all(axis=1)
    names = naming.names(model.State)
    return tuple(f"the slope of the rate of {names[i]}" for i in np.flatnonzero(~finite))
