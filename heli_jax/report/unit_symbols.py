"""Units as they are printed, without what figures need."""


def pretty(unit: str | None) -> str:
    """A unit as it is printed: kg m², 1/s²; `–` for a plain number."""
    if unit is None or unit in ("", "1"):
        return "–"
    return unit.replace("^2", "²").replace("^3", "³").replace("^4", "⁴").replace("*", " ")
