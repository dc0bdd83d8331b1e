"""Section `disturbance` of a configuration."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from heli_jax.config.section import Positive, Section
from heli_jax.errors import nearest


class DisturbanceConfig(Section):
    """Random disturbances of state derivatives: simulation draws them, filter error estimates them.

    `axis: roll` and `on: [roll]` are equivalent.
    """

    # `axis` has the parameters sigma_w and tau_w without a suffix; `on` with several gives each
    # state a size of its own.
    axis: str | None = None
    """one of the model's axes: roll, pitch, yaw, heave, ..."""
    on: str | Annotated[list[str], Field(min_length=1)] | None = None
    """states or axes, each with its own disturbance"""
    # Two poles make a disturbance smoother than lagged white noise; both have the same time
    # constant.
    poles: Literal[1, 2] = 1
    """1: an Ornstein-Uhlenbeck process; 2: passed through a second lag"""
    sigma_w: Positive | dict[str, Positive] | None = None
    """standard deviation, in the state's unit per second (SI), by name for several; required to
    simulate, an initial guess for filter error"""
    tau_w: Positive | dict[str, Positive] | None = None
    """correlation time [s], by name for several or one number for all, as sigma_w"""
    fixed: list[str] = []
    """parameters that filter error does not estimate: sigma_w, tau_w (for several sigma_w_p, ...),
    sigma_y (the outputs' sd)"""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the disturbed states or axes, as in the file."""
        on = self.on if self.axis is None else self.axis
        return (on,) if isinstance(on, str) else tuple(on or ())

    @property
    def parameters(self) -> dict[str, float | None]:
        """Value of each parameter by name, None if not given."""
        # The names must be those that `with_disturbance` gives to the parameters.
        several, values = len(self.names) > 1, {}
        for name in self.names:
            for key in ("sigma_w", "tau_w"):
                value = getattr(self, key)
                # Only a time constant may be one number for all: it is in seconds for any state.
                of_it = value.get(name) if isinstance(value, dict) else value
                values[f"{key}_{name}" if several else key] = of_it
        return values

    @model_validator(mode="after")
    def _consistent(self) -> "DisturbanceConfig":
        if (self.axis is None) == (self.on is None):
            got = "neither" if self.on is None else "both"
            raise ValueError(f"expected axis (one) or on (a list of states), got {got}")
        for key in ("sigma_w", "tau_w"):
            value = getattr(self, key)
            for name in value if isinstance(value, dict) else ():
                if name not in self.names:
                    raise ValueError(f"{key}: {name!r} is not disturbed{nearest(name, self.names)}")
        if len(self.names) > 1 and isinstance(self.sigma_w, float):
            # For states in different units, one number would have different meanings.
            example = ", ".join(f"{n}: {self.sigma_w:g}" for n in self.names)
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
