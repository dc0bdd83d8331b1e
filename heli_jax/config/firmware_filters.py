"""Filters of signals before they were logged, from the settings in the log.

PX4 filters `vehicle_angular_velocity` and `vehicle_acceleration` (VehicleAngularVelocity.cpp,
VehicleAcceleration.cpp). ArduPilot filters the gyros and accelerometers of all messages except the
raw ones (AP_InertialSensor_Backend.cpp). Betaflight and Rotorflight filter `gyroADC` (gyro_init.c).
Angles and velocities come from Kalman filters and similar estimators, whose effect no setting
describes.
"""

import re
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

from heli_jax.dynamics.onboard.filters import Filter

type Settings = Mapping[str, str | int | float]


class LoggedFilters(NamedTuple):
    """Filters of a signal, as far as the settings state them."""

    filters: tuple[Filter, ...]
    """Filters with fixed constants."""
    settings: tuple[str, ...]
    """Settings that state them, as `NAME = value`."""
    unknown: tuple[str, ...]
    """Settings of filters without constants: they move in flight or are of unknown kind."""


def logged_filters(firmware: str, settings: Settings, channel: str) -> LoggedFilters | None:
    """Return the filters of a channel; None if the log does not state them."""
    for pattern, reader in _CHANNELS:
        if re.fullmatch(pattern, channel):
            return reader(_Reading(firmware, settings))
    return None


class _Reading:
    """Settings of a log, and the filters collected from them."""

    def __init__(self, firmware: str, settings: Settings) -> None:
        self.firmware, self.settings = firmware, settings
        self.filters: list[Filter] = []
        self.used: list[str] = []
        self.unknown: list[str] = []

    def numbers(self, name: str) -> list[float]:
        """Return the numbers of a setting; empty if it is absent or holds something else."""
        try:
            return [float(part) for part in str(self.settings[name]).split(",")]
        except (KeyError, ValueError):
            return []

    def number(self, name: str) -> float:
        """Return the number of a setting; zero, which switches a filter off, if absent."""
        return next(iter(self.numbers(name)), 0.0)

    def add(self, name: str, *filters: Filter) -> None:
        """Add filters that a setting states."""
        self.filters += filters
        self.used.append(f"{name} = {self.settings[name]}")

    def moving(self, *names: str) -> None:
        """Note settings of filters that follow the flight, if they are not zero."""
        self.unknown += [f"{n} = {self.settings[n]}" for n in names if any(self.numbers(n))]

    @property
    def result(self) -> LoggedFilters:
        """All filters so far."""
        return LoggedFilters(tuple(self.filters), tuple(self.used), tuple(self.unknown))


def _px4_gyro(read: _Reading) -> LoggedFilters | None:
    if "IMU_GYRO_CUTOFF" not in read.settings:
        return None
    # NF_FREQ was the only static notch before version 1.12; NF0 and NF1 replaced it.
    for stem in ("IMU_GYRO_NF_", "IMU_GYRO_NF0_", "IMU_GYRO_NF1_"):
        name = f"{stem}FREQ" if stem.endswith("NF_") else f"{stem}FRQ"
        hz, width = read.number(name), read.number(f"{stem}BW")
        if hz > 0 and width > 0:
            read.add(name, Filter("notch", hz, hz / width))
    read.moving("IMU_GYRO_DNF_EN", "IMU_GYRO_FFT_EN")
    _biquad(read, "IMU_GYRO_CUTOFF")
    return read.result


def _biquad(read: _Reading, name: str) -> None:
    if read.number(name) > 0:
        read.add(name, Filter("biquad", read.number(name)))


def _accel(name: str) -> Callable[[_Reading], LoggedFilters | None]:
    """Return the reader of a channel with one low-pass."""

    def read(reading: _Reading) -> LoggedFilters | None:
        if name not in reading.settings:
            return None
        _biquad(reading, name)
        return reading.result

    return read


def _ardupilot_gyro(read: _Reading) -> LoggedFilters | None:
    if "INS_GYRO_FILTER" not in read.settings:
        return None
    # The static notch of versions 3.x and 4.0.
    hz, width = read.number("INS_NOTCH_FREQ"), read.number("INS_NOTCH_BW")
    if read.number("INS_NOTCH_ENABLE") and hz > width / 2 > 0:
        attenuation = read.number("INS_NOTCH_ATT") or 40.0
        notch = Filter("notch", hz, _octave_q(hz, hz - width / 2), attenuation)
        read.add("INS_NOTCH_FREQ", notch)
    # Harmonic notches follow the rotor, its throttle or a spectrum in most of their modes.
    read.moving("INS_HNTCH_ENABLE", "INS_HNTC2_ENABLE")
    _biquad(read, "INS_GYRO_FILTER")
    return read.result


def _octave_q(centre: float, edge: float) -> float:
    """Return the Q of a notch from its centre and lower edge [Hz] (filterGetNotchQ)."""
    return centre * edge / (centre**2 - edge**2)


def _blackbox_gyro(read: _Reading) -> LoggedFilters | None:
    rotorflight = read.firmware.startswith("Rotorflight")
    types = _ROTORFLIGHT if rotorflight else _BETAFLIGHT
    # Before version 4.3, Betaflight used gyro_lowpass_hz and similar names.
    stages = [
        stage
        for stage in (
            ("gyro_lpf1_type", "gyro_lpf1_static_hz", "gyro_lpf1_dyn_hz"),
            ("gyro_lpf2_type", "gyro_lpf2_static_hz", ""),
            ("gyro_lowpass_type", "gyro_lowpass_hz", "gyro_lowpass_dyn_hz"),
            ("gyro_lowpass2_type", "gyro_lowpass2_hz", ""),
        )
        if stage[1] in read.settings
    ]
    if not stages:
        return None
    if rotorflight:
        _decimation(read)
    for type_name, name, moving in stages:
        hz, kind = read.number(name), next(iter(read.numbers(type_name)), -1.0)
        if rotorflight and kind == 0:  # none in Rotorflight, a lag in Betaflight
            continue
        if _moves(read.numbers(moving), hz, rotorflight):
            read.moving(moving)
        elif hz > 0 and kind in types:
            read.add(name, types[kind](hz))
        elif hz > 0:
            read.unknown.append(f"{name} = {hz:g} of type {kind:g}")
    for hz, edge in zip(
        read.numbers("gyro_notch_hz"), read.numbers("gyro_notch_cutoff"), strict=False
    ):
        if 0 < edge < hz:
            read.add("gyro_notch_hz", Filter("notch", hz, _octave_q(hz, edge)))
    read.moving("dyn_notch_count", "rpm_filter_harmonics", "gyro_rpm_notch_harmonics")
    read.moving("gyro_rpm_filter_bank_motor_index")
    return read.result


def _rotorflight_raw(read: _Reading) -> LoggedFilters | None:
    """Return the filters of `gyroRAW`, which is logged after the decimation."""
    if "gyro_decimation_hz" not in read.settings:
        return None
    _decimation(read)
    return read.result


def _decimation(read: _Reading) -> None:
    # A fourth-order Bessel filter precedes the decimation to the loop's rate.
    hz = read.number("gyro_decimation_hz")
    if hz > 0:
        first = Filter("biquad", 1.603357516 * hz, 0.805538282)
        read.add("gyro_decimation_hz", first, Filter("biquad", 1.430171560 * hz, 0.521934582))


def _moves(limits: list[float], hz: float, rotorflight: bool) -> bool:
    """True if a low-pass follows throttle or headspeed.

    In Betaflight the limits decide it; in Rotorflight the fixed frequency is also between the two
    limits.
    """
    if len(limits) != 2 or not limits[0] > 0:
        return False
    return limits[0] <= hz <= limits[1] if rotorflight else limits[1] > limits[0]


type _Kinds = Mapping[float, Callable[[float], Filter]]


def _pt(kind: Literal["pt1", "pt2", "pt3"]) -> Callable[[float], Filter]:
    return lambda hz: Filter(kind, hz)


# In the order of the enumerations in their filter.h. Rotorflight 4.6 inserts PT4, which moves the
# last four, so its types from 6 on are not read.
_BETAFLIGHT: _Kinds = {
    0: _pt("pt1"), 1: lambda hz: Filter("biquad", hz), 2: _pt("pt2"), 3: _pt("pt3"),
}  # fmt: skip
_ROTORFLIGHT: _Kinds = {
    1: _pt("pt1"), 3: _pt("pt1"), 4: _pt("pt2"), 5: _pt("pt3"),
    2: lambda hz: Filter("biquad", 1.272019649 * hz, 0.577350269),  # Bessel
}  # fmt: skip

_CHANNELS: tuple[tuple[str, Callable[[_Reading], LoggedFilters | None]], ...] = (
    (r"vehicle_angular_velocity(\[\d+\])?\.xyz\[[012]\]", _px4_gyro),
    (r"vehicle_acceleration(\[\d+\])?\.xyz\[[012]\]", _accel("IMU_ACCEL_CUTOFF")),
    (r"RATE\.[RPY]|IMU\d?(\[\d+\])?\.Gyr[XYZ]|SIDD\.G[xyz]", _ardupilot_gyro),
    (r"IMU\d?(\[\d+\])?\.Acc[XYZ]|SIDD\.A[xyz]", _accel("INS_ACCEL_FILTER")),
    (r"gyroADC\[[012]\]", _blackbox_gyro),
    (r"gyroRAW\[[012]\]", _rotorflight_raw),
)
