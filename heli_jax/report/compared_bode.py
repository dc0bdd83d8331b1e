"""The frequency responses of several runs' simulated outputs over that of the measured one."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from heli_jax.analysis.response_curves import COHERENT
from heli_jax.identification.result import Signals
from heli_jax.report import style
from heli_jax.report.figures.panels import panels, sample_time
from heli_jax.report.frequency import Empirical, empirical, phase

BODE_WORDS = (
    "By the spectra of the record's input with the measured and with each simulated output, in the "
    f"same segments, where coherence is above {COHERENT}: what leakage and other inputs do to one "
    "they do to all."
)


def bode_overlay(
    by_run: Sequence[tuple[str, Signals]], flight: str, output: str, input: str
) -> Figure | None:
    """Gain and phase from an input to the measured output and to each run's simulated one.

    None where no run's simulated output has a coherent response to the input.

    Args:
        by_run: by the runs' labels, the same flight.
        flight: its name.
        output: which.
        input: which; runs whose model has none of that name are left out.
    """
    with_input = [(label, s) for label, s in by_run if input in s.inputs]
    curves = [
        (label, response)
        for label, s in with_input
        if (response := _response(s, input, s.simulated[output])) is not None
    ]
    if not curves:
        return None
    first = with_input[0][1]
    measured = _response(first, input, first.measured[output])
    above, below = panels(None, 4.0, [1.2, 1.0])
    if measured is not None:
        dots = {"ls": "", "marker": "o", "ms": 2.6, "mew": 0, "color": style.GREY}
        above.plot(measured.omega / _TURN, _decibels(measured), label="measured", **dots)
        below.plot(measured.omega / _TURN, phase(measured.H), label="measured", **dots)
    for i, (label, response) in enumerate(curves):
        look = {"color": style.CYCLE[i % len(style.CYCLE)], "lw": 1.2}
        above.plot(response.omega / _TURN, _decibels(response), label=label, **look)
        below.plot(response.omega / _TURN, phase(response.H), label=label, **look)
    above.set_xscale("log")
    style.plain_log_ticks(above)
    above.set_title(f"{input} to {output}, {style.short(flight)}", loc="left")
    above.set_ylabel("magnitude [dB]")
    below.set_ylabel("phase [deg]")
    style.phase_ticks(below)
    below.set_xlabel("frequency [Hz]")
    style.legend_above(above)
    return above.figure  # pyright: ignore[reportReturnType]


def _response(s: Signals, input: str, y: np.ndarray) -> Empirical | None:
    """Where it is coherent; None where that is nowhere, samples are missing or y diverges."""
    if not (np.isfinite(y).all() and np.max(np.abs(y)) < _HUGE):
        return None
    # The memory of zero: how long a machine remembers is not known here, and all have the same
    # segments.
    record = empirical(s.inputs[input], y, sample_time(s), 0.0)
    if isinstance(record, str):
        return None
    good = (record.coherence > COHERENT) & (np.abs(record.H) > 0)
    if good.sum() < _FEWEST:
        return None
    return record._replace(omega=record.omega[good], H=record.H[good])


def _decibels(response: Empirical) -> np.ndarray:
    return 20.0 * np.log10(np.abs(response.H))


_TURN = 2.0 * np.pi
"""rad/s of 1 Hz"""
_HUGE = 1e9
"""what no output of a machine reaches"""
_FEWEST = 3
"""frequencies that make a curve"""
