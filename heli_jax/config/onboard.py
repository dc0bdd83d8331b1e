"""Section `onboard`: devices around a model, from the swashplate outwards."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, model_validator

from heli_jax.config.section import Positive, Section
from heli_jax.dynamics.model import Model
from heli_jax.dynamics.onboard.delays import ORDER, with_delays
from heli_jax.dynamics.onboard.filters import Filter, check_delay
from heli_jax.dynamics.onboard.rate_loop import with_gyro, with_rate_loop
from heli_jax.dynamics.onboard.sensors import with_sensors
from heli_jax.dynamics.onboard.servos import with_servos
from heli_jax.errors import located


def _one_or_several(value: object) -> object:
    # One is the usual case and needs no list.
    return [value] if isinstance(value, dict | Section) else value


NamesOrPairs = list[str] | dict[str, str]
# Largest order that `with_delays` accepts; checked here, where the key has a place.
Order = Annotated[int, Field(ge=1, le=8)]


class ServosConfig(Section):
    """Equal servos on some inputs (`with_servos`)."""

    on: list[str]
    """inputs that these servos move"""
    # Off by default: it is the only device here that makes a linear model nonlinear, and the exact
    # step is then not available.
    rate_limit: bool = False
    """true: limit their speed (rate_servo)"""
    delay: bool = False
    """true: delay them (delay_servo)"""
    name: Annotated[str, Field(pattern="^[A-Za-z][A-Za-z0-9_]*$")] = "servo"
    """ends the names of its parameters: omega_servo, ..."""


class RateLoopConfig(Section):
    """A flybarless unit (`with_rate_loop`)."""

    on: NamesOrPairs | None = None
    """sticks, or {stick: state that is its rate}; default those of roll and pitch"""
    integral: bool = True
    """true: integral term Ki"""
    feedforward: bool = True
    """true: feed-forward term Kff"""
    lag: bool = False
    """true: first-order lag of its gyro (tau_gyro)"""


class GyroConfig(Section):
    """A gyro on the tail (`with_gyro`)."""

    on: NamesOrPairs | None = None
    """pedal, or {pedal: state that is its rate}; default that of yaw"""
    heading_hold: bool = True
    """true: the pedal commands a rate that is held; false: damper only"""
    lag: bool = True
    """true: first-order lag of its gyro (tau_gyro)"""


class SensorsConfig(Section):
    """Sensors of the log (`with_sensors`)."""

    imu: bool = False
    """adds the specific forces ax, ay, az at the accelerometer's position"""
    angular_acceleration: bool = False
    """adds the derivatives of the rates"""
    airspeed: bool = False
    """adds the airspeed and its components at the probe"""
    lowpass: list[str] = []
    """outputs with a first-order lag (tau_lowpass)"""
    delay: NamesOrPairs = []
    """outputs with a delay, or {output: parameter of its delay}"""
    order: Order = ORDER
    """number of states that approximate each delay"""


class DelaysConfig(Section):
    """Delays of inputs and outputs (`with_delays`)."""

    inputs: NamesOrPairs = []
    """names, or {name: parameter}"""
    outputs: NamesOrPairs = []
    """names, or {name: parameter}"""
    order: Order = ORDER
    """number of states that approximate each delay"""


FROM_LOG = "from log"
"""Kind of filter that the log's own settings state."""


class FilterConfig(Section):
    """A filter between a sensor and the log (`Filter`)."""

    kind: Literal["pt1", "pt2", "pt3", "biquad", "notch", "from log"]
    """kind of low-pass or notch; from log: from the settings in the log"""
    hz: Positive | None = None
    """cut-off (3 dB) of a low-pass, or centre of a notch"""
    q: Positive | None = None
    """quality of a biquad or notch"""
    bandwidth: Positive | None = None
    """width of a notch [Hz], in place of q"""
    attenuation: Positive | None = None
    """depth of a notch at its centre [dB]"""

    @model_validator(mode="after")
    def _consistent(self) -> "FilterConfig":
        if self.kind == FROM_LOG:
            if self.model_fields_set - {"kind"}:
                raise ValueError("from log: expected no numbers beside it, got some")
        elif self.hz is None:
            raise ValueError(f"hz: missing, {self.kind} needs its frequency")
        elif self.bandwidth is not None and (self.kind != "notch" or self.q is not None):
            raise ValueError("bandwidth: expected it for a notch, in place of q")
        else:
            self.filter.checked()
        return self

    @property
    def filter(self) -> Filter:
        """Filter with these numbers; not valid for one from the log."""
        assert self.hz is not None  # checked in `_consistent`
        q = self.q if self.bandwidth is None else self.hz / self.bandwidth
        numbers = {} if self.attenuation is None else {"attenuation": self.attenuation}
        return Filter(self.kind, self.hz, q, **numbers)


def _filters(value: object) -> object:
    return [{"kind": FROM_LOG}] if value == FROM_LOG else _one_or_several(value)


def _delay(value: float) -> float:
    check_delay(value, "delay")
    return value


Filters = Annotated[
    list[FilterConfig],
    BeforeValidator(
        _filters, json_schema_input_type=Literal["from log"] | FilterConfig | list[FilterConfig]
    ),
]
Delay = Annotated[float, AfterValidator(_delay)]


class OnboardConfig(Section):
    """Devices between stick and blade, motion and log, each in series with the previous one."""

    servos: Annotated[
        list[ServosConfig],
        BeforeValidator(_one_or_several, json_schema_input_type=ServosConfig | list[ServosConfig]),
    ] = []
    """one kind of servo, or a list of kinds"""
    rate_loop: RateLoopConfig | None = None
    """a flybarless unit"""
    gyro: GyroConfig | None = None
    """a gyro on the tail"""
    sensors: SensorsConfig | None = None
    """sensors of the motion"""
    delays: DelaysConfig | None = None
    """radio and log"""


def with_onboard(model: Model, config: OnboardConfig | None, path: Path) -> Model:
    """Return the model with the devices of a configuration.

    Args:
        config: the section, or None.
        path: the configuration file.

    Raises:
        InputError: a device that the model cannot have.
    """
    if config is None:
        return model
    # The order matters: a rate loop commands the servos, sensors measure the resulting motion, and
    # the radio's delay is outermost.
    steps: list[tuple[str, Callable[..., Model], BaseModel]] = [
        *(("servos", with_servos, servos) for servos in config.servos),
        *(
            (key, function, section)
            for key, function, section in (
                ("rate_loop", with_rate_loop, config.rate_loop),
                ("gyro", with_gyro, config.gyro),
                ("sensors", with_sensors, config.sensors),
                ("delays", with_delays, config.delays),
            )
            if section is not None
        ),
    ]
    for key, function, section in steps:
        with located(f"{path}: onboard.{key}"):
            # By name: a key that only the function or only the section has is an error here.
            model = function(model, **dict(section))
    return model
