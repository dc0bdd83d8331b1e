"""Whether what a model states by name (delays, axes, positive parameters) is there.

A name that is wrong here is no error of Python: an axis would be ignored, and a delay fail in the
middle of a fit.
"""

from collections.abc import Iterator
from typing import Any, NoReturn

from heli_jax import naming, units
from heli_jax.dynamics.model import Axis
from heli_jax.errors import nearest

# The model is anyone's, and its fields are whatever a user has passed.


def check_names(model: Any) -> None:
    """Refuse delays, axes and positive parameters that name what the model has not.

    Args:
        model: whose classes `Params`, `State`, `Inputs` have been checked, with `name`, `delays`,
            `axes` and `positive`.

    Raises:
        ValueError: naming the place, what was expected and what was got.
    """
    _check_delays(model)
    for axis in _tuple(model, "axes", model.axes if model.axes is not None else ()):
        if not isinstance(axis, Axis):
            _refuse(model, "axes", f"expected every one an Axis, got {axis!r:.60}")
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
        # A delay is taken as seconds, whatever its field says.
        unit = naming.unit(model.Params, parameter)
        if unit is not None and not _is_second(unit):
            problem = f"expected {parameter} in s, got {unit!r}"
            _refuse(model, f"delays of {stick}", problem)
        # Two would be two readings of one record at different times, and later code keeps them by
        # input: the second would replace the first without a word.
        if stick in late:
            _refuse(model, "delays", f"expected one delay of {stick}, got two")
        late.add(stick)


def _is_second(unit: str) -> bool:
    try:
        # Milliseconds are refused as well: the parameter's value would be taken for seconds as it
        # stands, a delay a thousand times too long.
        return units.factor(unit, "s") == 1.0
    except ValueError:
        return False


def _names_of(model: Any, axis: Axis) -> Iterator[tuple[str, str, Any]]:
    """(field, role, name) of what an axis names."""
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
    """The value, which has to be a tuple: a model is compiled, so nothing in it may change."""
    # An Axis is a tuple itself: `axes=(Axis(...))` without its comma would pass for a tuple of
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
