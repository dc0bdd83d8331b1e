"""What every figure of a fit begins with: panels below each other, their labels in line."""

from typing import TYPE_CHECKING

from heli_jax.identification.result import Signals
from heli_jax.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

type Panels = tuple[Axes, ...]

# A fixed distance [inch], and not matplotlib's `align_ylabels`: that measures the tick labels of
# every panel at each drawing, and figures of the same kind would differ with their numbers' widths.
_LABELS_LEFT = 0.57


def panels(
    figure: "Figure | None",
    height: float,
    ratios: list[float],
    *,
    sharex: bool = True,
    right: float = 0.2,
    top: float = style.TOP,
) -> "Panels":
    """Panels below each other in a given figure or a new one.

    Args:
        figure: to draw on, with the margins it has; a new one where None.
        height: of a new figure [inch].
        ratios: heights of the panels, relative to each other.
        sharex: whether the panels have one x axis.
        right: margin of a new figure [inch].
        top: likewise, above the first panel.
    """
    n = len(ratios)
    # Panels with an x axis each need room for its tick labels.
    gap = 0.22 if sharex else 0.36
    from matplotlib.transforms import ScaledTranslation

    drawing = style.figure(height) if figure is None else figure
    axes = drawing.subplots(n, 1, sharex=sharex, squeeze=False, height_ratios=ratios)[:, 0]
    if figure is None:
        style.place(drawing, n, right=right, gap=gap, top=top)
    for ax in axes:
        at = ax.transAxes + ScaledTranslation(-_LABELS_LEFT, 0.0, drawing.dpi_scale_trans)
        ax.yaxis.set_label_coords(0.0, 0.5, transform=at)
    return tuple(axes)


def sample_time(signals: Signals) -> float:
    """Time between samples [s]; 1 for a single sample, which has none."""
    return float(signals.times[1] - signals.times[0]) if signals.times.size > 1 else 1.0
