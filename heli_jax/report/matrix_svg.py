"""The matrix of correlations as SVG, a coloured cell with its number for each pair."""

from html import escape

import numpy as np

from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.report.figures.estimates import LEFT_OUT, MATRIX_TITLE, cell_text
from heli_jax.report.svg import QUIET, WIDTH, Drawing, opened, width_of

_CELL, _TOP = 46.0, 52.0
_LARGEST = 9
"""cells in a row up to which they have their full size"""
# The ends and the middle of Brewer's PuOr: told apart with every common kind of colour blindness.
_ORANGE, _MIDDLE, _VIOLET = (127, 59, 8), (247, 247, 247), (45, 0, 75)


def correlation_svg(verdict: Verdict) -> tuple[str, Drawing]:
    """Title and image: near +1 or -1 the data cannot tell two parameters apart.

    Args:
        verdict: names and correlations.
    """
    names, r = verdict.names, verdict.correlation
    n = len(names)
    left = 12.0 + max(width_of(name, 11.0) for name in names)
    # The names below stand aslant, and the last ones may reach further than the matrix.
    cell = min(_CELL, (WIDTH - left - 20.0) / n) if n > _LARGEST else _CELL
    size = 11.0 if n <= _LARGEST else max(6.0, 0.22 * cell)
    below = _TOP + n * cell
    parts = [f'<text x="{left:.1f}" y="24" font-size="13" font-weight="bold">{MATRIX_TITLE}</text>']
    if verdict.undetermined:
        parts.append(f'<text x="{left:.1f}" y="41" fill="{QUIET}">{LEFT_OUT}</text>')
    for (i, j), value in np.ndenumerate(r):
        x, y = left + j * cell, _TOP + i * cell
        ink = "white" if abs(value) > 0.6 else "black"  # to be read on a dark cell
        parts.append(
            f'<rect x="{x + 0.75:.1f}" y="{y + 0.75:.1f}" width="{cell - 1.5:.1f}" '
            f'height="{cell - 1.5:.1f}" fill="{_colour(float(value))}"/>'
            f'<text x="{x + 0.5 * cell:.1f}" y="{y + 0.5 * cell + 0.35 * size:.1f}" fill="{ink}" '
            f'font-size="{size:.1f}" text-anchor="middle">{cell_text(float(value), i == j)}</text>'
        )
    for k, name in enumerate(names):
        middle = (k + 0.5) * cell
        parts.append(
            f'<text x="{left - 6:.1f}" y="{_TOP + middle + 4:.1f}" text-anchor="end">'
            f"{escape(name)}</text>"
            f'<text text-anchor="end" transform="translate({left + middle + 4:.1f} '
            f'{below + 14:.1f}) rotate(-35)">{escape(name)}</text>'
        )
    height = round(below + 22 + 0.6 * max(width_of(name, 11.0) for name in names))
    wide = min(WIDTH, round(max(left + n * cell + 20, left + width_of(LEFT_OUT, 12.0))))
    return MATRIX_TITLE, Drawing(opened(wide, height) + "".join(parts) + "</svg>\n", (wide, height))


def _colour(r: float) -> str:
    """Of a correlation; grey where there is none."""
    if not np.isfinite(r):
        return "#dddddd"
    end, share = (_VIOLET if r > 0 else _ORANGE), min(abs(r), 1.0)
    mixed = (round(m + share * (e - m)) for m, e in zip(_MIDDLE, end, strict=True))
    return "#" + "".join(f"{v:02x}" for v in mixed)
