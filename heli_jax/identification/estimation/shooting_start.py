"""A start where the model's simulation diverges: parameters from short windows first.

Where a damping begins with the wrong sign, a simulation over the whole record grows by many powers
of ten, and least squares finds no way back: the gradient is all in the growth. Over short windows,
each from an initial state of its own, nothing has the time to grow (multiple shooting; Bock, 1983).
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax import naming
from heli_jax.finding import note
from heli_jax.identification.estimation import multistart as starting
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import start_vector
from heli_jax.identification.unknowns.layout import Layout, Noise, layout_of

FAR_WORSE = 10.0
"""times the misfit of no model at all from which a start is taken for one that diverges"""
_WINDOWS = 16
"""of the shortest flight, unless they had too few samples each"""
_PER_STATE = 5
"""samples that a window has at least for each initial state that it brings"""
_STEPS = 60
"""of the optimiser over the windows: what has not arrived by then is only a start"""

BY_WINDOWS = note(
    "search.by-windows",
    "The simulation diverges at the start values, so the parameters were first fitted to short "
    "windows of the record (multiple shooting), and the fit began from there.",
)


def by_windows(
    problem: Problem, search: starting.Search, noise: Noise, e: Evaluation, z0: Array, best: Optimum
) -> Optimum | None:
    """The optimum from the parameters that short windows give, where the search from z0 failed
    and the simulation diverges there; None where that is not so or windows do not help.

    Args:
        problem: what is fitted.
        search: the optimiser over the whole record.
        noise: that it searches with.
        e: at z0.
        z0: the start.
        best: the best optimum so far.
    """
    # Only where the ordinary way failed: windows bring unknowns of their own and a program to
    # compile.
    if bool(best.converged) or not _applies(problem) or not _diverges(search, noise, e):
        return None
    cut = _cut(problem)
    short = None if cut is None else _fit_of_windows(cut, search.layout, noise, z0)
    if short is None:
        return None
    # The windows' initial states stay behind: they were free to take up what the parameters missed.
    [run] = search.run(noise, z0.at[: short.size].set(short)[None, :])
    return run if starting.rank(run) < starting.rank(best) else None


def _fit_of_windows(cut: Problem, whole: Layout, noise: Noise, z0: Array) -> Array | None:
    """What the flights share, fitted to the windows; None where that is not finite."""
    layout = layout_of(cut, cut.training)
    data = data_of(cut, cut.training, layout)
    # It stands first in z in either layout; behind it windows have more.
    z = start_vector(layout, data, cut)
    z = z.at[: whole.first_nuisance].set(z0[: whole.first_nuisance])
    [short] = starting.Search(cut, layout, data, _STEPS).run(noise, z[None, :])
    # Not whether it converged: half a way out of the growth is enough to begin from.
    finite = np.isfinite(short.cost) and bool(jnp.all(jnp.isfinite(short.z)))
    return short.z[: whole.first_nuisance] if finite else None


def _applies(problem: Problem) -> bool:
    # What `Problem` accepts with windows, and has none yet.
    return (
        estimator_of(problem.method).windows
        and problem.window is None
        and problem.nuisance.initial_state
    )


def _diverges(search: starting.Search, noise: Noise, e: Evaluation) -> bool:
    """Whether the misfit is far larger than that of no model at all."""
    # Squares of a run that diverged may overflow: infinity is past the limit too.
    with np.errstate(all="ignore"):
        misfit = float(np.sum(np.square(np.asarray(e.r, np.float64))))
    return misfit > FAR_WORSE * search.misfit_of_nothing(noise)


def _cut(problem: Problem) -> Problem | None:
    """The problem in windows; None where the record is too short for them."""
    states = len(naming.names(problem.model.State))
    flights = problem.training
    dt = max(f.dt for f in flights)
    shortest = min(f.n_samples * f.dt for f in flights)
    # Short enough that nothing grows, long enough that a window's samples outnumber its unknowns.
    window = max(shortest / _WINDOWS, max(8, _PER_STATE * states) * dt)
    return replace(problem, window=window) if window < 0.5 * shortest else None
