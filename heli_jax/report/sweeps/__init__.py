"""Quick-look figures of a sweep: a Dataset over `element` in, matplotlib Figures out.

Elements that are not ok, and values that are not finite, count in no median and no histogram; the
former are marked in red where their axes are finite. A result of several flights is drawn as its
mean over them. Draw within `matplotlib.rc_context(style.STYLE)`, as `write_figures` does, to
get the report's look.
"""

from heli_jax.report.sweeps.columns import results
from heli_jax.report.sweeps.corner import corner
from heli_jax.report.sweeps.files import RESULTS, write_figures
from heli_jax.report.sweeps.maps import maps
from heli_jax.report.sweeps.slices import slices
from heli_jax.report.sweeps.worst import worst

__all__ = ["RESULTS", "corner", "maps", "results", "slices", "worst", "write_figures"]
