"""Sensors between motion and log: accelerometers, low-passes, delays."""

import functools
import math
from collections.abc import Sequence
from typing import Any

from heli_jax import naming
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Model, zeros
from heli_jax.dynamics.onboard.delays import ORDER, Late, with_delays
from heli_jax.dynamics.onboard.device import Device, Parts, Quantity, require
from heli_jax.dynamics.onboard.motion_sensors import with_motion_sensors
from heli_jax.naming import Record


def with_sensors(
    model: Model,
    lowpass: Sequence[str] = (),
    delay: Late = (),
    *,
    imu: bool = False,
    angular_acceleration: bool = False,
    airspeed: bool = False,
    order: int = ORDER,
) -> Model:
    r"""The model as its sensors see it: what they show of the motion, then low-passes, then delays.

    An accelerometer adds the outputs `ax`, `ay`, `az` [m/s^2] along the body (forward, right,
    down): the specific force at (`x_imu`, `y_imu`, `z_imu`) [m] from the centre of gravity, new
    parameters (`heli_jax.dynamics.onboard.motion_sensors`). A low-pass is first order,
    `tau_lowpass_OUTPUT` [s] with the state `OUTPUT_lowpass`. Delays are those of `with_delays`.

    Args:
        lowpass: outputs that are low-passed, `ax` and its like among them.
        delay: outputs that are late, by names or by name the parameter.
        imu: whether there is an accelerometer.
        angular_acceleration: whether `pdot`, `qdot`, `rdot` [rad/s^2] are outputs.
        airspeed: whether `airspeed` and `u_air`, `v_air`, `w_air` [m/s] are outputs, at (`x_air`,
            `y_air`, `z_air`) [m] from the centre of gravity.
        order: states of each delay's line.

    Raises:
        ValueError: no such output, velocities that the model does not know, or a name that is
            taken.
    """
    check_model(model)
    motion = {"imu": imu, "angular_acceleration": angular_acceleration, "airspeed": airspeed}
    if not (any(motion.values()) or lowpass or delay):
        raise ValueError(f"expected {', '.join(motion)}, lowpass or delay, got none")
    # In the order of the signal's way to the log, so that a low-pass can be on what the IMU shows.
    # The delay comes last since its line follows slow signals best: behind the low-pass it errs
    # least.
    model = with_motion_sensors(model, **motion) if any(motion.values()) else model
    model = _with_lowpass(model, tuple(lowpass)) if lowpass else model
    return with_delays(model, outputs=delay, order=order) if delay else model


@functools.cache
def _with_lowpass(model: Model, on: tuple[str, ...]) -> Model:
    require(on, model.Outputs, "output", model)
    return _LowPass(model, on).made("lowpass", lambda bare: _with_lowpass(bare, on))


class _LowPass(Device):
    """First-order lags on some outputs."""

    def __init__(self, model: Model, on: tuple[str, ...]) -> None:
        params = {
            f"tau_lowpass_{n}": Quantity(
                "s", f"time constant of the low-pass on {n}", math.nan, True
            )
            for n in on
        }
        states = {
            f"{n}_lowpass": Quantity(naming.unit(model.Outputs, n), f"{n}, low-passed") for n in on
        }
        super().__init__(model, Parts(params, states))
        self.on = on

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """The derivatives of the low-passed outputs, per second."""
        y = self.measured(p, s, u)
        return {
            f"{n}_lowpass": (getattr(y, n) - getattr(s, f"{n}_lowpass"))
            / getattr(p, f"tau_lowpass_{n}")
            for n in self.on
        }

    def shown(self, p: Record, s: Record, u: Record, y: Record) -> Record:
        """The outputs, those that are low-passed read from their states.

        Args:
            y: the outputs before the low-pass.
        """
        return naming.replace(y, **{n: getattr(s, f"{n}_lowpass") for n in self.on})

    def first(self, p: Record) -> dict[str, Any]:
        # As if the machine had always been where it starts.
        y = self.model.output(p, self.model.initial_state(p), zeros(self.model.Inputs))
        # Zero in its place would show as a start-up transient of the filter, which a logger that
        # runs before the record begins has long behind it.
        return {f"{n}_lowpass": getattr(y, n) for n in self.on}
