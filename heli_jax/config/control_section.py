"""Section `control`: a controller and how it is judged."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from heli_jax.config.run_sections import NoiseConfig, StartConfig
from heli_jax.config.section import Finite, Positive, Section


class AcceptableConfig(Section):
    """Largest acceptable deviation of a signal or command."""

    most: Positive
    """deviation from steady flight that costs one, in `unit`"""
    limit: Positive | None = None
    """largest command, or output of a loop of pid, in `unit`"""
    unit: str | None = None
    """unit; default the model's SI unit"""
    integral: Positive | None = None
    """time [s] over which the largest deviation may last: removes the steady error (lqr)"""
    full_stick: Positive | None = None
    """command at full output of the autopilot, in `unit`: writes gains for ArduPilot and PX4 (pid)
    """
    step: Finite | None = None
    """step of the set point, in `unit`, that is flown; a number gives the signal a set point"""
    bandwidth: Positive | None = None
    """least bandwidth [rad/s] of the response to the set point, kept by the tuning: up to it the
    phase stays above -135 deg (ADS-33, attitude command)"""


class GustConfig(Section):
    """Random change of an input, a first-order process."""

    sd: Positive
    """standard deviation [SI unit of the input, m/s for wind]"""
    tau: Positive = 1.0
    """correlation time [s]"""


class ControlConfig(Section):
    """Controller that `heli-jax control` computes, and its test over the posterior of a fit."""

    law: Literal["lqr", "lqg", "pid"] = "lqr"
    """lqr: regulator with the true states; lqg: with a Kalman filter of the outputs in `sensors`;
    pid: the cascades of `loops`"""
    rate: Annotated[float, Field(gt=0, le=10_000)]
    """steps of the controller a second [Hz]"""
    signals: dict[str, AcceptableConfig] = {}
    """outputs and states, by name"""
    inputs: dict[str, AcceptableConfig]
    """commanded inputs, by name"""
    loops: dict[str, dict[str, Positive]] = {}
    """pid: by input, the crossover [rad/s] of each signal from the outermost loop to the innermost
    """
    integral: tuple[str, ...] = ()
    """pid: signals with an integral"""
    sensors: dict[str, NoiseConfig] = {}
    """signals with the sd of the white noise in what the controller reads; lqg: the measured
    outputs"""
    noise: dict[str, Positive] = {}
    """lqg: square root of the spectral density of white noise at inputs, or of the rates of states
    [SI times sqrt(s)]: dx: 0.3 is an acceleration of 0.3 m/s^2 sqrt(s)"""
    start: StartConfig = StartConfig()
    """steady flight of the full helicopter"""
    gusts: dict[str, GustConfig] = {}
    """random changes that are flown: of wind_x, wind_y, wind_z (full helicopter), or of any input
    """
    duration: Positive = 10.0
    """length of the simulated flight [s]"""
    fit: str | None = None
    """run directory of the fit whose posterior the vehicles are drawn from; default: --fit"""
    samples: Annotated[int, Field(ge=1, le=10_000)] = 200
    """vehicles of the posterior for which the controller is judged"""
    vehicles: Annotated[int, Field(ge=1, le=1000)] = 16
    """vehicles for which the gains are tuned"""
    distance: Annotated[float, Field(ge=0, lt=1)] = 0.5
    """least distance of every loop from -1: 0.5 is a gain margin of 6 dB upwards and 3.5 dB
    downwards, and a phase margin of 29 deg"""
    max_steps: Annotated[int, Field(ge=0)] = 200
    """most steps of the tuning; 0: no tuning"""
    seed: Annotated[int, Field(ge=0)] = 0
    """seed of vehicles and gusts"""

    @model_validator(mode="after")
    def _complete(self) -> "ControlConfig":
        if not self.inputs:
            raise ValueError("inputs: expected a commanded input, got none")
        if not self.signals and self.law != "pid":
            raise ValueError("signals: expected a signal to control, got none")
        for name in (n for n in self.inputs if n.startswith("wind_")):
            raise ValueError(f"inputs: expected an input that can be commanded, got {name!r}")
        unused = {
            "integral": self.integral and self.law != "pid",
            "noise": self.noise and self.law != "lqg",
        }
        for key in (k for k, given in unused.items() if given):
            raise ValueError(f"{key}: not for law: {self.law}, expected none")
        for name, one in {**self.signals, **self.inputs}.items():
            if one.full_stick is not None and (self.law != "pid" or name in self.signals):
                raise ValueError(f"{name}.full_stick: expected of an input with law: pid alone")
            if one.limit is not None and self.law != "pid" and name in self.signals:
                raise ValueError(f"signals.{name}.limit: expected with law: pid alone")
        if self.law == "pid" and not self.loops:
            raise ValueError("loops: missing, law: pid needs them")
        if self.law != "pid" and self.loops:
            raise ValueError(f"loops: expected with law: pid alone, got law: {self.law}")
        for key in ("sensors", "noise") if self.law == "lqg" else ():
            if not getattr(self, key):
                raise ValueError(f"{key}: expected with law: lqg, got none")
        for name, one in self.signals.items():
            if one.bandwidth is not None and one.step is None:
                raise ValueError(f"signals.{name}.step: missing, bandwidth needs a set point")
        for name in set(self.loops) ^ set(self.inputs) if self.loops else ():
            raise ValueError(f"loops: expected the same names as inputs, got {name!r} in one")
        return self
