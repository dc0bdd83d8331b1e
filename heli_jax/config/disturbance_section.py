"""Section `disturbance` of a configuration."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, model_validator

from heli_jax.config.section import Section
from heli_jax.errors import nearest


def _has_unit(value: Any) -> bool:
    """True if this is one number with its unit, not a mapping of numbers by name."""
    return isinstance(value, dict) and "value" in value


def _size_choice(value: Any) -> Any:
    """Return one positive number, or one by name for each of several disturbances.

    Numbers are in SI, or have the form {value, unit}; None means left out.
    """
    if value is None:
        return None
    if isinstance(value, dict) and not _has_unit(value):
        return {str(k): _size(v) for k, v in value.items()}
    return _size(value)


def _size(value: Any) -> Any:
    number = value["value"] if _has_unit(value) else value
    # In Python true is the number 1. Infinity has no spread to draw from, and is no time constant.
    real = isinstance(number, int | float) and not isinstance(number, bool)
    if not (real and 0 < number < float("inf")):
        raise ValueError(
            "expected a number above zero (SI, or {value, unit}), or one number by name for each "
            f"disturbance, got {number!r:.60}"
        )
    # The unit is checked where the model, and so the unit of the disturbed state, is known.
    return value if _has_unit(value) else float(value)


def _plain(value: Any) -> str:
    return f"{value['value'] if _has_unit(value) else value:g}"


def _on_choice(value: Any) -> Any:
    if value is None:
        return None
    names = [value] if isinstance(value, str) else value
    if not (isinstance(names, list) and names and all(isinstance(n, str) for n in names)):
        raise ValueError(f"expected a state, or a list of them such as [p, q], got {value!r:.60}")
    return tuple(names)


_Size = Annotated[
    Any, BeforeValidator(_size_choice, json_schema_input_type=float | dict[str, Any] | None)
]


class DisturbanceConfig(Section):
    """Random disturbances of state derivatives: simulation draws them, filter error estimates them.

    `axis: roll` and `on: [roll]` are equivalent.
    """

    # `axis` has the parameters sigma_w and tau_w without a suffix; `on` with several gives each
    # state a size of its own.
    axis: str | None = None
    """one of the model's axes: roll, pitch, yaw, heave, ..."""
    # Any here and below, because the validator before it defines the allowed values.
    on: Annotated[
        Any, BeforeValidator(_on_choice, json_schema_input_type=str | list[str] | None)
    ] = None
    """states or axes, each with its own disturbance"""
    # Two poles make a disturbance smoother than lagged white noise; both have the same time
    # constant.
    poles: Literal[1, 2] = 1
    """1: an Ornstein-Uhlenbeck process; 2: passed through a second lag"""
    sigma_w: _Size = None
    """standard deviation, in the state's unit per second (SI) or as {value, unit}, by name for
    several; required to simulate, an initial guess for filter error"""
    tau_w: _Size = None
    """correlation time [s], by name for several or one number for all, as sigma_w"""
    fixed: list[str] = []
    """parameters that filter error does not estimate: sigma_w, tau_w (for several sigma_w_p, ...),
    sigma_y (the outputs' sd)"""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the disturbed states or axes, as in the file."""
        return self.on if self.axis is None else (self.axis,)

    @property
    def has_units(self) -> bool:
        """True if some number has its own unit and is not in SI yet."""
        values = (self.sigma_w, self.tau_w)
        return any(
            _has_unit(v) or (isinstance(v, dict) and any(map(_has_unit, v.values())))
            for v in values
        )

    @property
    def parameters(self) -> dict[str, float | None]:
        """Value of each parameter by name, None if not given."""
        # The names must be those that `with_disturbance` gives to the parameters.
        several, values = len(self.names) > 1, {}
        for name in self.names:
            for key in ("sigma_w", "tau_w"):
                value = getattr(self, key)
                # Only a time constant may be one number for all: it is in seconds for any state.
                by_name = isinstance(value, dict) and not _has_unit(value)
                of_it = value.get(name) if by_name else value
                values[f"{key}_{name}" if several else key] = of_it
        return values

    @model_validator(mode="after")
    def _consistent(self) -> "DisturbanceConfig":
        if (self.axis is None) == (self.on is None):
            got = "neither" if self.on is None else "both"
            raise ValueError(f"expected axis (one) or on (a list of states), got {got}")
        for key in ("sigma_w", "tau_w"):
            value = getattr(self, key)
            by_name = isinstance(value, dict) and not _has_unit(value)
            for name in value if by_name else ():
                if name not in self.names:
                    raise ValueError(f"{key}: {name!r} is not disturbed{nearest(name, self.names)}")
        if len(self.names) > 1 and (isinstance(self.sigma_w, float) or _has_unit(self.sigma_w)):
            # For states in different units, one number would have different meanings.
            example = ", ".join(f"{n}: {_plain(self.sigma_w)}" for n in self.names)
            raise ValueError(
                f"sigma_w: expected a value for each disturbance, as {{{example}}}, got one"
            )
        for name in self.fixed:
            if name not in (*self.parameters, "sigma_y"):
                known = ", ".join((*self.parameters, "sigma_y"))
                raise ValueError(f"fixed: expected some of {known}, got {name!r}")
            # A missing value starts with a guess from the record, and a guess must not be fixed.
            if name != "sigma_y" and self.parameters[name] is None:
                raise ValueError(f"{name}: missing, expected its value, since it is fixed")
        return self
