"""Handling qualities as rows of text, and as lines of the terminal."""

from collections.abc import Sequence

import numpy as np

from heli_jax.analysis.attitude_responses import Handling
from heli_jax.analysis.handling_qualities import NUMBERS, UNITS, HandlingQualities, Number
from heli_jax.numbers import measured, number
from heli_jax.report.tables.table import NOT_DETERMINED, Table

_WORDS = {
    "bandwidth": "bandwidth",
    "phase_bandwidth": "phase bandwidth",
    "gain_bandwidth": "gain bandwidth",
    "w180": "ω₁₈₀",
    "phase_delay": "phase delay",
    "phase_delay_line": "phase delay by the line",
    "crossover": "crossover",
    "phase_margin": "phase margin",
    "gain_margin": "gain margin",
}
_NO_RESULT = "the parameters that it hangs on are not determined, or no optimum was reached."
_HEADLINES = ("bandwidth", "phase_delay", "crossover", "phase_margin", "gain_margin")
"""what the terminal shows"""
_AS_READ = {"s": ("ms", 1e3)}
"""by SI unit the one that is shown, and how many make it: delays are milliseconds"""


def handling(entries: Sequence[Handling]) -> Table:
    """A row for each number of each response, with the columns that were asked for.

    Args:
        entries: what model and data say.
    """
    sources = _sources(entries)
    rows = []
    for entry in entries:
        for name in NUMBERS[entry.pair.kind]:
            cells = (_cell(getattr(entry, s), name) for s in sources)
            rows.append((entry.pair.words, _WORDS[name], *cells, _unit(name)[0]))
    return Table(("response", "", *sources, "unit"), rows)


def _sources(entries: Sequence[Handling]) -> tuple[str, ...]:
    return tuple(s for s in ("model", "data") if any(getattr(e, s) is not None for e in entries))


def _cell(of: HandlingQualities | str | None, name: str) -> str:
    value = of.numbers.get(name) if isinstance(of, HandlingQualities) else None
    if value is None or not value.known:
        return NOT_DETERMINED
    # Pilots' criteria count in rad/s, rotors and filters in Hz.
    hz = f", {number(value.value / (2.0 * np.pi), 3)} Hz" if UNITS[name] == "rad/s" else ""
    return _shown(value, _unit(name)[1]) + hz


def _unit(name: str) -> tuple[str, float]:
    return _AS_READ.get(UNITS[name], (UNITS[name], 1.0))


def _shown(n: Number, times: float) -> str:
    value, low, high, _ = measured(
        times * n.sd, *(times * v for v in (n.value, n.lower95, n.upper95))
    )
    return f"{value} ({low} to {high})"


def handling_sentences(entries: Sequence[Handling]) -> list[str]:
    """Why numbers are missing, and what is to be heeded."""
    said = []
    for entry in entries:
        for source in _sources(entries):
            of = getattr(entry, source)
            sentences = (of,) if isinstance(of, str) else () if of is None else of.sentences
            if isinstance(of, HandlingQualities) and not all(n.known for n in of.numbers.values()):
                sentences = (*sentences, _NO_RESULT)
            said += [f"{entry.pair.words}, {source}: {s}" for s in sentences]
    return said


def handling_lines(entries: Sequence[Handling]) -> list[str]:
    """One line each: `lat to phi: bandwidth [rad/s] model 5.1 (5 to 5.3), 0.812 Hz`

    Args:
        entries: what model and data say.
    """
    sources = _sources(entries)
    lines = []
    for entry in entries:
        parts = []
        for name in _HEADLINES:
            if name in NUMBERS[entry.pair.kind]:
                cells = ", ".join(f"{s} {_cell(getattr(entry, s), name)}" for s in sources)
                parts.append(f"{_WORDS[name]} [{_unit(name)[0]}] {cells}")
        lines.append(f"{entry.pair.words}: {'; '.join(parts)}")
    return lines
