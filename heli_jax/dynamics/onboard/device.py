"""Devices around a model, between stick and blade or between motion and log."""

import abc
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, NamedTuple

from heli_jax import naming, units
from heli_jax.dynamics.model import Model, SteadyFlight, require_continuous
from heli_jax.errors import nearest
from heli_jax.naming import Record, Scalar


class Quantity(NamedTuple):
    """A parameter, state or output that a device adds."""

    unit: str | None
    """SI unit; None if the model's unit is unknown."""
    meaning: str
    default: float | None = None
    """Default of a parameter; for NaN the vehicle or a start value must give it."""
    positive: bool = False

    @property
    def annotation(self) -> Any:
        """Annotation of the field in a record class."""
        return Scalar if self.unit is None else Annotated[Scalar, self.unit, self.meaning]


class Parts(NamedTuple):
    """Parameters, states and functions that a device adds to a model."""

    params: Mapping[str, Quantity]
    states: Mapping[str, Quantity]
    outputs: Mapping[str, Quantity] = {}
    linear: bool = True
    """True if the device is linear in state and inputs, without a constant term."""


class Device(abc.ABC):
    """A model with a device around it.

    Devices are compared by identity, since a model is static to `jax.jit`. Each is made once and
    cached.
    """

    def __init__(self, model: Model, parts: Parts) -> None:
        self.model = model
        require_continuous(model, type(self).__name__.strip("_"))
        # Check first: a name that is taken would silently replace the model's own field.
        _check_new(model, parts)
        title = type(self).__name__.strip("_")

        def with_more(record: type, more: Mapping[str, Quantity]) -> type:
            # Keep the same class if nothing is added, because its name is the model's.
            fields = {n: (q.annotation, q.default) for n, q in more.items()}
            return naming.extended(record, f"{record.__name__}{title}", fields) if more else record

        self.parts = parts
        self.Params = with_more(model.Params, parts.params)
        self.State = with_more(model.State, parts.states)
        self.Outputs = with_more(model.Outputs, parts.outputs)

    def inputs(self, p: Record, s: Record, u: Record) -> Record:
        """Return the inputs that reach the model; by default the outer ones."""
        return u

    @abc.abstractmethod
    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the time derivatives of the device's own states."""

    def shown(self, p: Record, s: Record, u: Record, y: Record) -> Record:
        """Return the outputs, given those of the model."""
        return y

    def first(self, p: Record) -> dict[str, Any]:
        """Return the device's own states at the first sample (at rest)."""
        # Zeros computed from a parameter have its type and batch axis.
        zero = 0.0 * getattr(p, naming.names(self.Params)[0])
        return dict.fromkeys(self.parts.states, zero)

    def inner(self, s: Record) -> Record:
        """Return the State of the inner model."""
        return self.model.State(**{n: getattr(s, n) for n in naming.names(self.model.State)})

    def vector_field(self, p: Record, s: Record, u: Record) -> Record:
        """Return the time derivatives of model and device."""
        of_model = self.model.vector_field(p, self.inner(s), self.inputs(p, s, u))
        # The device's states come last, so that matrices of the model keep their rows and columns.
        return self.State(**naming.asdict(of_model), **self.rates(p, s, u))

    def output(self, p: Record, s: Record, u: Record) -> Record:
        """Return the logged outputs."""
        return self.shown(p, s, u, self.measured(p, s, u))

    def measured(self, p: Record, s: Record, u: Record) -> Record:
        """Return the outputs of the inner model."""
        return self.model.output(p, self.inner(s), self.inputs(p, s, u))

    def start(self, p: Record) -> Record:
        """Return the state at the first sample."""
        return self.State(**naming.asdict(self.model.initial_state(p)), **self.first(p))

    def noise_intensity(self, p: Record) -> Record:
        """Return the process-noise intensity of the model, zero for the device's states."""
        assert self.model.noise_intensity is not None
        # Sensor noise is measurement noise, which the fit models separately.
        own = naming.asdict(self.model.noise_intensity(p))
        zero = 0.0 * next(iter(own.values()))
        return self.State(**own, **dict.fromkeys(self.parts.states, zero))

    def limits(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the model's limits, evaluated with the inputs that reach it."""
        assert self.model.limits is not None
        return self.model.limits(p, self.inner(s), self.inputs(p, s, u))

    def made(self, suffix: str, again: Callable[[Model], Model], **changes: Any) -> Model:
        """Return the model with its device.

        Args:
            again: puts the same device around another model, the one in `Model.within`.
        """
        model, states = self.model, tuple(self.parts.states)
        steady = model.steady_flight
        if steady is not None:
            # The device is at rest in steady flight too: its states are unknowns, their derivatives
            # zero.
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
            # A filter or delay line may be stiff.
            "explicit": False,
            "start": self.start,
            "noise_intensity": None if model.noise_intensity is None else self.noise_intensity,
            "limits": None if model.limits is None else self.limits,
            "steady_flight": steady,
            "positive": (*model.positive, *positive),
            "within": _around(model.within, again),
        }
        # Other fields stay unchanged. `initial_sd`, `correlation`, axes and delays refer to names,
        # which the larger State still has.
        return dataclasses.replace(model, **{**fields, **changes})


def _around(
    within: tuple[Model, Callable[[Model], Model]] | None, again: Callable[[Model], Model]
) -> tuple[Model, Callable[[Model], Model]] | None:
    """Return `Model.within` after one more device is added."""
    if within is None:
        return None
    model, before = within
    return model, lambda other: again(before(other))


def _check_new(model: Model, parts: Parts) -> None:
    """Raise if the model already has a name that the device adds."""
    records = {
        "parameter": (model.Params, parts.params),
        "state": (model.State, parts.states),
        "output": (model.Outputs, parts.outputs),
    }
    for kind, (record, more) in records.items():
        for name in more:
            if name in naming.names(record):
                raise ValueError(
                    f"model {model.name} has a {kind} {name!r} already, expected another device"
                )


def require(names: Iterable[str], record: type, kind: str, model: Model) -> None:
    """Raise if names are missing from the model's record, repeated, or none at all.

    Raises:
        ValueError: with the first wrong name.
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
    """Return the SI unit of a quotient; None if either unit is unknown or not SI.

    Args:
        above: unit of the numerator, for example `rad/s`.
    """
    if above is None or below is None:
        return None
    try:
        # Exponents of the base units let equal units cancel: rad/s over 1 must give rad/s.
        exponents = units.base_of(above), units.base_of(below)
        # Params are stored in SI. If a unit needs a factor, no unit is better than one wrong by it.
        si = all(
            units.factor(u, units.as_text(e)) == 1.0
            for u, e in zip((above, below), exponents, strict=True)
        )
    except ValueError:  # a unit that the user defined and that has no conversion
        return None
    if not si:
        return None
    names = dict.fromkeys((*exponents[0], *exponents[1]))
    both = {n: exponents[0].get(n, 0) - exponents[1].get(n, 0) for n in names}
    return units.as_text({n: power for n, power in both.items() if power})
