"""A device around a model: what stands between stick and blade, or between motion and log."""

import abc
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, NamedTuple

from heli_jax import naming, units
from heli_jax.dynamics.model import Model, SteadyFlight
from heli_jax.errors import nearest
from heli_jax.naming import Record, Scalar


class Quantity(NamedTuple):
    """A parameter, a state or an output that a device brings."""

    unit: str | None
    """SI; None where that of the model is unknown"""
    meaning: str
    default: float | None = None
    """of a parameter; NaN has to be given, by the vehicle or as a start value"""
    positive: bool = False

    @property
    def annotation(self) -> Any:
        """As a record class has it."""
        return Scalar if self.unit is None else Annotated[Scalar, self.unit, self.meaning]


class Parts(NamedTuple):
    """Parameters, states and functions that a device adds to a model."""

    params: Mapping[str, Quantity]
    states: Mapping[str, Quantity]
    outputs: Mapping[str, Quantity] = {}
    linear: bool = True
    """whether it is linear in state and inputs, and zero where both are"""


class Device(abc.ABC):
    """A model with a device around it; a subclass says what the device does.

    Compared by identity, since a model is static to `jax.jit`: each is made once and kept.
    """

    def __init__(self, model: Model, parts: Parts) -> None:
        self.model = model
        # Before anything is made: a name that is taken would silently replace the model's own
        # field.
        _check_new(model, parts)
        title = type(self).__name__.strip("_")

        def with_more(record: type, more: Mapping[str, Quantity]) -> type:
            # The same class where nothing is added: its name is that of the model.
            fields = {n: (q.annotation, q.default) for n, q in more.items()}
            return naming.extended(record, f"{record.__name__}{title}", fields) if more else record

        self.parts = parts
        self.Params = with_more(model.Params, parts.params)
        self.State = with_more(model.State, parts.states)
        self.Outputs = with_more(model.Outputs, parts.outputs)

    def inputs(self, p: Record, s: Record, u: Record) -> Record:
        """The inputs that reach the model; those from outside unless the device drives it."""
        return u

    @abc.abstractmethod
    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """The derivatives of the device's own states, per second."""

    def shown(self, p: Record, s: Record, u: Record, y: Record) -> Record:
        """The outputs, from those of the model."""
        return y

    def first(self, p: Record) -> dict[str, Any]:
        """The device's own states at the first sample: at rest."""
        # Zeros made of a parameter have its type and its batch axis.
        zero = 0.0 * getattr(p, naming.names(self.Params)[0])
        return dict.fromkeys(self.parts.states, zero)

    def inner(self, s: Record) -> Record:
        """The State of the model itself."""
        return self.model.State(**{n: getattr(s, n) for n in naming.names(self.model.State)})

    def vector_field(self, p: Record, s: Record, u: Record) -> Record:
        """Derivatives of the model behind its device."""
        of_model = self.model.vector_field(p, self.inner(s), self.inputs(p, s, u))
        # The device's states stand behind the model's: matrices of the model keep their rows and
        # columns.
        return self.State(**naming.asdict(of_model), **self.rates(p, s, u))

    def output(self, p: Record, s: Record, u: Record) -> Record:
        """Logged outputs."""
        return self.shown(p, s, u, self.measured(p, s, u))

    def measured(self, p: Record, s: Record, u: Record) -> Record:
        """The outputs of the model itself."""
        return self.model.output(p, self.inner(s), self.inputs(p, s, u))

    def start(self, p: Record) -> Record:
        """The state at the first sample."""
        return self.State(**naming.asdict(self.model.initial_state(p)), **self.first(p))

    def noise_intensity(self, p: Record) -> Record:
        """The model's own; no device adds noise to the state."""
        assert self.model.noise_intensity is not None
        # A device computes or filters: noise of a sensor is measurement noise, which the fit has by
        # itself.
        own = naming.asdict(self.model.noise_intensity(p))
        zero = 0.0 * next(iter(own.values()))
        return self.State(**own, **dict.fromkeys(self.parts.states, zero))

    def limits(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Limits of the model, with the inputs that reach it."""
        assert self.model.limits is not None
        return self.model.limits(p, self.inner(s), self.inputs(p, s, u))

    def made(self, suffix: str, again: Callable[[Model], Model], **changes: Any) -> Model:
        """The Model with its device.

        Args:
            again: puts the same device around another model, the one in `Model.within`.
        """
        model, states = self.model, tuple(self.parts.states)
        steady = model.steady_flight
        if steady is not None:
            # The device rests too: a state more to solve for, and its derivative to vanish.
            steady = SteadyFlight((*states, *steady.unknowns), (*states, *steady.equations))
        # Time constants, frequencies and damping of a device are above zero whatever the model
        # around which it stands: a fit then searches their logarithm.
        positive = tuple(n for n, q in self.parts.params.items() if q.positive)
        fields = {
            "name": f"{model.name}+{suffix}",
            "vector_field": self.vector_field,
            "output": self.output,
            "Params": self.Params,
            "State": self.State,
            "Outputs": self.Outputs,
            "linear": model.linear and self.parts.linear,
            # A filter or a line of delays may be as fast as it likes.
            "explicit": False,
            "start": self.start,
            "noise_intensity": None if model.noise_intensity is None else self.noise_intensity,
            "limits": None if model.limits is None else self.limits,
            "steady_flight": steady,
            "positive": (*model.positive, *positive),
            "within": _around(model.within, again),
        }
        # Fields that are not named stay unchanged. `initial_sd` and `correlation` go by names of
        # states, so they hold for a State that has grown; axes and delays name what is still there.
        return dataclasses.replace(model, **{**fields, **changes})


def _around(
    within: tuple[Model, Callable[[Model], Model]] | None, again: Callable[[Model], Model]
) -> tuple[Model, Callable[[Model], Model]] | None:
    """`Model.within` of a model that gets one more device around it."""
    if within is None:
        return None
    model, before = within
    return model, lambda other: again(before(other))


def _check_new(model: Model, parts: Parts) -> None:
    """Refuse a device whose names the model has already: one would hide the other."""
    records = {
        "parameter": (model.Params, parts.params),
        "state": (model.State, parts.states),
        "output": (model.Outputs, parts.outputs),
    }
    for kind, (record, more) in records.items():
        for name in more:
            if name in naming.names(record):
                raise ValueError(
                    f"model {model.name} has a {kind} {name!r} already, expected a device that it "
                    "has not"
                )


def require(names: Iterable[str], record: type, kind: str, model: Model) -> None:
    """Refuse names that a model's record does not have, none at all, and one twice.

    Raises:
        ValueError: naming the first that is wrong.
    """
    seen: set[str] = set()
    known = naming.names(record)
    for name in names:
        if name not in known:
            raise ValueError(f"model {model.name} has no {kind} {name!r}{nearest(name, known)}")
        if name in seen:
            raise ValueError(f"{kind} {name!r} is named twice, expected it once")
        seen.add(name)
    if not seen:
        raise ValueError(f"expected at least one {kind} of {', '.join(known)}, got none")


def quotient(above: str | None, below: str | None) -> str | None:
    """The SI unit of one quantity per unit of another; None where either is unknown or not SI.

    Args:
        above: unit of the first, as `rad/s`.
    """
    if above is None or below is None:
        return None
    try:
        # By exponents of the base units and not as text: rad/s over 1 has to come out as rad/s, and
        # what cancels has to vanish.
        exponents = units.base_of(above), units.base_of(below)
        # Params are kept in SI. A unit that would need a factor is not that of a stored number, and
        # no unit is better than one that is wrong by it.
        si = all(
            units.factor(u, units.as_text(e)) == 1.0
            for u, e in zip((above, below), exponents, strict=True)
        )
    except ValueError:  # a unit of the user's own, which nobody converts
        return None
    if not si:
        return None
    names = dict.fromkeys((*exponents[0], *exponents[1]))
    both = {n: exponents[0].get(n, 0) - exponents[1].get(n, 0) for n in names}
    return units.as_text({n: power for n, power in both.items() if power})
