"""Handling qualities as plain data, of fit.json and of handling_qualities.json."""

from collections.abc import Sequence
from typing import Any

from heli_jax.analysis.attitude_responses import Handling
from heli_jax.analysis.handling_qualities import NUMBERS, UNITS, HandlingQualities


def handling_json(entries: Sequence[Handling]) -> list[dict[str, Any]]:
    """Plain data: by response what model and data say, numbers in SI (and deg, dB)."""
    return [
        {**entry.pair._asdict(), "model": _plain(entry.model), "data": _plain(entry.data)}
        for entry in entries
    ]


def _plain(of: HandlingQualities | str | None) -> dict[str, Any] | None:
    if of is None:
        return None
    if isinstance(of, str):
        return {"numbers": {}, "sentences": [of]}
    return {
        # What is not determined is null, and not left out: programs ask by name.
        "numbers": {
            name: {**of.numbers[name]._asdict(), "unit": UNITS[name]}
            if name in of.numbers and of.numbers[name].known
            else None
            for name in NUMBERS[of.kind]
        },
        "sentences": list(of.sentences),
        "sign": of.sign,
        "band_rad_s": list(of.band),
    }
