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
from heli_jax.dynamics.onboard.specific_force import motion_of, specific_force
from heli_jax.naming import Record


def with_sensors(
    model: Model,
    lowpass: Sequence[str] = (),
    delay: Late = (),
    *,
    imu: bool = False,
    order: int = ORDER,
) -> Model:
    r"""The model as its sensors see it: an accelerometer, then low-passes, then delays.

    An accelerometer adds the outputs `ax`, `ay`, `az` [m/s^2] along the body (forward, right,
    down): the specific force at (`x_imu`, `y_imu`, `z_imu`) [m] from the centre of gravity, new
    parameters (`heli_jax.dynamics.onboard.specific_force`). A low-pass is first order,
    `tau_lowpass_OUTPUT` [s] with the state `OUTPUT_lowpass`. Delays are those of `with_delays`.

    Args:
        model: any.
        lowpass: outputs that are low-passed, `ax` and its like among them.
        delay: outputs that are late, by names or by name the parameter.
        imu: whether there is an accelerometer.
        order: states of each delay's line.

    Raises:
        ValueError: no such output, velocities that the model does not know, or a name that is
            taken.
    """
    check_model(model)
    if not (imu or lowpass or delay):
        raise ValueError("expected imu, lowpass or delay, got none")
    # In the order of the signal's way to the log, so that a low-pass can be on what the IMU shows.
    # The delay comes last since its line follows slow signals best: behind the low-pass it errs
    # least.
    model = _with_imu(model) if imu else model
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
        """The derivatives of the low-passed outputs, per second.

        Args:
            p: the Params of the whole model, SI.
            s: its State, with the states added here.
            u: its Inputs, as they come from outside.
        """
        y = self.measured(p, s, u)
        return {
            f"{n}_lowpass": (getattr(y, n) - getattr(s, f"{n}_lowpass"))
            / getattr(p, f"tau_lowpass_{n}")
            for n in self.on
        }

    def shown(self, p: Record, s: Record, u: Record, y: Record) -> Record:
        """The outputs, those that are low-passed read from their states.

        Args:
            p: the Params of the whole model, SI.
            s: its State, with the states added here.
            u: its Inputs, as they come from outside.
            y: the outputs before the low-pass.
        """
        return naming.replace(y, **{n: getattr(s, f"{n}_lowpass") for n in self.on})

    def first(self, p: Record) -> dict[str, Any]:
        # As if the machine had always been where it starts.
        y = self.model.output(p, self.model.initial_state(p), zeros(self.model.Inputs))
        # Zero in its place would show as a start-up transient of the filter, which a logger that
        # runs before the record begins has long behind it.
        return {f"{n}_lowpass": getattr(y, n) for n in self.on}


@functools.cache
def _with_imu(model: Model) -> Model:
    return _Imu(model).made("imu", _with_imu)


class _Imu(Device):
    """Accelerometers somewhere in the body."""

    def __init__(self, model: Model) -> None:
        self.motion = motion_of(model)
        ahead = {"x": "ahead of", "y": "to the right of", "z": "below"}
        params = {
            f"{axis}_imu": Quantity("m", f"IMU {where} the centre of gravity", 0.0)
            for axis, where in ahead.items()
        }
        words = {"ax": "forward", "ay": "to the right", "az": "down"}
        outputs = {
            n: Quantity("m/s^2", f"specific force {words[n]} at the IMU")
            for n in self.motion.outputs
        }
        # Its place has zero as default, the centre of gravity, where the levers vanish: the one
        # position that needs no measurement. Nothing else here has a default.
        super().__init__(model, Parts(params, {}, outputs))

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """None: an accelerometer has no states.

        Args:
            p: the Params of the whole model, SI.
            s: its State, with the states added here.
            u: its Inputs, as they come from outside.
        """
        return {}

    def output(self, p: Record, s: Record, u: Record) -> Record:
        """The model's outputs and the specific force beside them [m/s^2].

        Args:
            p: the Params of the whole model, SI.
            s: its State, with the states added here.
            u: its Inputs, as they come from outside.
        """
        y = naming.asdict(self.measured(p, s, u))
        return self.Outputs(**y, **specific_force(self.model, self.motion, p, s, u))
