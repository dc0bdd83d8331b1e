"""Excitations as autopilots and transmitters play them.

ArduPilot plays chirps in its mode SYSTEMID (parameters SID_*), Betaflight from 4.6 on in its mode
CHIRP. Neither plays another signal, and PX4 and Rotorflight play none. A transmitter with EdgeTX
plays any signal by a script in its mixer.
"""

import math
from collections.abc import Sequence

import numpy as np

_PLACES = {"input": (1, "rad"), "rate": (7, "rad/s"), "mixer": (10, "1")}
ARDUPILOT = {
    f"{place}-{axis}": (first + i, unit)
    for place, (first, unit) in _PLACES.items()
    for i, axis in enumerate(("roll", "pitch", "yaw"))
} | {"input-yaw": (3, "rad/s"), "mixer-thrust": (13, "1")}
"""SID_AXIS, and the unit of the chirp, by the place where it is added."""
_LEAST_DEADTIME = 0.02
"""Time between two steps of a mixer script [s]."""
_FULL = 1024
"""Full deflection of EdgeTX."""


def ardupilot_parameters(
    band: tuple[float, float], axis: str, magnitude: float, duration: float, fade: float
) -> str:
    """Return a parameter file for `ardupilot_chirp` in ArduPilot's mode SYSTEMID.

    Args:
        band: first and last frequency [Hz].
        axis: key of `ARDUPILOT`.
        magnitude: deflection, SI.
        duration: duration of the chirp [s].
        fade: duration of its begin and its end [s].
    """
    low, high = band
    number, unit = ARDUPILOT[axis]
    lines = {
        "SID_AXIS": number,
        # Mixer axes take shares of full output, the others degrees.
        "SID_MAGNITUDE": f"{magnitude if unit == '1' else math.degrees(magnitude):.4g}",
        "SID_F_START_HZ": f"{low:.4g}",
        "SID_F_STOP_HZ": f"{high:.4g}",
        "SID_T_FADE_IN": f"{fade:.4g}",
        "SID_T_REC": f"{duration:.4g}",
        "SID_T_FADE_OUT": f"{fade:.4g}",
    }
    return "".join(f"{name},{value}\n" for name, value in lines.items())


def betaflight_commands(
    band: tuple[float, float], axis: str, amplitude: float, duration: float
) -> str:
    """Return commands of Betaflight's command line for `betaflight_chirp` in its mode CHIRP.

    Args:
        band: first and last frequency [Hz].
        axis: roll, pitch or yaw.
        amplitude: largest set point [rad/s].
        duration: duration of the chirp [s].
    """
    low, high = band
    lines = {
        # The filter passes the chirp unchanged if its pole and its zero are equal.
        "chirp_lag_freq_hz": "30",
        "chirp_lead_freq_hz": "30",
        # Whole degrees a second, within the limit.
        f"chirp_amplitude_{axis}": f"{max(1, math.floor(math.degrees(amplitude) + 1e-6))}",
        "chirp_frequency_start_deci_hz": f"{10.0 * low:.0f}",
        "chirp_frequency_end_deci_hz": f"{10.0 * high:.0f}",
        "chirp_time_seconds": f"{math.floor(duration + 1e-9)}",
    }
    return "".join(f"set {name} = {value}\n" for name, value in lines.items()) + "save\n"


def transmitter_script(dt: float, shares: Sequence[tuple[str, np.ndarray]]) -> str:
    """Return a mixer script for EdgeTX that plays excitations while its switch is on.

    Args:
        dt: sample time [s].
        shares: name and samples (N,) of each output, as shares of full deflection.
    """
    every = max(1, round(_LEAST_DEADTIME / dt))
    tables = []
    for _, share in shares:
        steps = np.round(_FULL * np.clip(share[::every], -1.0, 1.0)).astype(int)
        tables.append("{" + ",".join(map(str, steps)) + "}")
    outputs = ", ".join(f'"{name[:4]}"' for name, _ in shares)
    returned = ", ".join(f"tables[{i + 1}][k]" for i in range(len(shares)))
    rest = ", ".join("0" for _ in shares)
    newline = ",\n  "
    return f"""-- EdgeTX: copy to SCRIPTS/MIXES, choose a switch, add the outputs to the mixes.
local tables = {{
  {newline.join(tables)}
}}
local step = {100.0 * dt * every:g} -- hundredths of a second
local begin = nil

local function run(switch)
  if switch < 512 then
    begin = nil
    return {rest}
  end
  begin = begin or getTime()
  local k = math.floor((getTime() - begin) / step) + 1
  if k > #tables[1] then
    return {rest}
  end
  return {returned}
end

return {{ input = {{ {{ "Switch", SOURCE }} }}, output = {{ {outputs} }}, run = run }}
"""
