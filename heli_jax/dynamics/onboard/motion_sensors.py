"""Sensors of the body's motion, as a device: accelerometers, angular acceleration, airspeed."""

import functools
from typing import Any

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.dynamics.onboard.device import Device, Parts, Quantity, quotient
from heli_jax.dynamics.onboard.motion_outputs import (
    airspeed,
    angular_acceleration,
    motion_of,
    rate_of,
    specific_force,
)
from heli_jax.naming import Record

_AXES = {"x": "ahead of", "y": "to the right of", "z": "below"}
_ALONG = {"x": "forward", "y": "to the right", "z": "down"}


def with_motion_sensors(
    model: Model, *, imu: bool = False, angular_acceleration: bool = False, airspeed: bool = False
) -> Model:
    """The model with outputs that its sensors make of the motion; each costs only if asked for.

    Args:
        imu: whether there is an accelerometer: outputs ax, ay, az [m/s^2], the specific force at
            the new parameters x_imu, y_imu, z_imu [m].
        angular_acceleration: whether pdot, qdot, rdot [rad/s^2] are shown, the derivatives of the
            body's rates as far as the model has these.
        airspeed: whether the speed through the air is shown, at the new parameters x_air, y_air,
            z_air [m]: u_air, v_air, w_air along the body and their norm airspeed [m/s].

    Raises:
        ValueError: the model does not know what is asked for, or has the name already.
    """
    asked = {"imu": imu, "angular_acceleration": angular_acceleration, "airspeed": airspeed}
    return _with_sensors(model, tuple(name for name, on in asked.items() if on))


# Cached: a model is static to jit, and a second one of the same kind would be compiled again.
@functools.cache
def _with_sensors(model: Model, shown: tuple[str, ...]) -> Model:
    def again(other: Model) -> Model:
        return _with_sensors(other, shown)

    # What the sensors show is made of derivatives, so a push on these has to come before them:
    # `with_disturbance` puts it on the model within.
    return _MotionSensors(model, shown).made("+".join(shown), again, within=(model, again))


class _MotionSensors(Device):
    """Sensors somewhere in the body, without a dynamics of their own."""

    def __init__(self, model: Model, shown: tuple[str, ...]) -> None:
        self.asked = shown
        self.motion = motion_of(model) if {"imu", "airspeed"} & set(shown) else None
        rates = {letter: rate_of(model, letter) for letter in "pqr"}
        self.body_rates = {letter: rate for letter, rate in rates.items() if rate is not None}
        params: dict[str, Quantity] = {}
        outputs: dict[str, Quantity] = {}
        if "imu" in shown:
            params |= _place("imu", "IMU")
            outputs |= self._forces()
        if "angular_acceleration" in shown:
            outputs |= self._accelerations(model)
        if "airspeed" in shown:
            params |= _place("air", "airspeed probe")
            outputs |= self._speeds(model)
        super().__init__(model, Parts(params, {}, outputs))

    def _forces(self) -> dict[str, Quantity]:
        assert self.motion is not None
        return {
            n: Quantity("m/s^2", f"specific force {_ALONG[n[1]]} at the IMU")
            for n in self.motion.outputs
        }

    def _accelerations(self, model: Model) -> dict[str, Quantity]:
        if not self.body_rates:
            raise ValueError(
                f"model {model.name} has no rates of its body, expected states or outputs p, q, r "
                "or axes named roll, pitch, yaw"
            )
        words = {"p": "roll", "q": "pitch", "r": "yaw"}
        quantities = {}
        for letter, (kind, name) in self.body_rates.items():
            record = model.State if kind == "state" else model.Outputs
            unit = quotient(naming.unit(record, name), "s")
            meaning = f"angular acceleration of {words[letter]}"
            quantities[f"{letter}dot"] = Quantity(unit, meaning)
        return quantities

    def _speeds(self, model: Model) -> dict[str, Quantity]:
        assert self.motion is not None
        windy = "wind_x" in naming.names(model.Inputs)
        if self.motion.kind != "ground" and windy and "psi" not in naming.names(model.State):
            raise ValueError(
                f"model {model.name} has a wind over the ground and speeds along its body, "
                "expected a state psi that tells where it heads"
            )
        speeds = {
            f"{'uvw'['xyz'.index(axis)]}_air": Quantity("m/s", f"airspeed {_ALONG[axis]}")
            for axis in self.motion.along
        }
        if self.motion.kind == "linear":
            return speeds
        return {"airspeed": Quantity("m/s", "airspeed at the probe"), **speeds}

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """None: these sensors have no states."""
        return {}

    def output(self, p: Record, s: Record, u: Record) -> Record:
        """The model's outputs and those of the sensors beside them."""
        model, motion = self.model, self.motion
        s = self.inner(s)
        # Once for all sensors: it is the field that costs.
        rates = model.vector_field(p, s, u)
        y = naming.asdict(model.output(p, s, u))
        if "imu" in self.asked and motion is not None:
            y |= specific_force(model, motion, p, s, u, rates)
        if "angular_acceleration" in self.asked:
            y |= {
                f"{letter}dot": angular_acceleration(model, rate, p, s, u, rates)
                for letter, rate in self.body_rates.items()
            }
        if "airspeed" in self.asked and motion is not None:
            y |= airspeed(model, motion, p, s, u, rates)
        return self.Outputs(**y)


def _place(suffix: str, what: str) -> dict[str, Quantity]:
    # Zero as default, the centre of gravity, where the levers vanish: the one position that needs
    # no measurement.
    return {
        f"{axis}_{suffix}": Quantity("m", f"{what} {where} the centre of gravity", 0.0)
        for axis, where in _AXES.items()
    }
