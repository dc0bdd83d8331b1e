"""`heli-jax windows`: which parts of a log say most of what a configuration has free."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from heli_jax import config as configuration
from heli_jax.config import Experiment
from heli_jax.errors import InputError
from heli_jax.identification.fit import windows
from heli_jax.identification.validation.record_windows import ENOUGH, Ranking, Window

_MOST = 40
"""windows in the table; those that were taken are always in it"""


def rank_log(
    experiment: Experiment,
    log: str | None = None,
    length: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Ranking:
    """What each window of a configuration's logs says of its free parameters.

    Args:
        experiment: the configuration; windows that it states for its flights are left out of
            account, and what it holds out is not ranked.
        log: in place of the configuration's, read as its first flight's is.
        length: of a window [s].
        progress: called with what the log's reader assumed, in words.

    Raises:
        InputError: the log or something of the configuration is wrong, or no window may be used.
    """
    config, path = experiment.config, experiment.path
    if not config.flights:
        raise InputError(f"{path}: flights: expected at least one log, got none")
    if log is not None:
        whole = {"log": str(Path(log).absolute()), "window": None, "hold_out": False}
        flights = [config.flights[0].model_copy(update=whole)]
    else:
        kept = [f.model_copy(update={"window": None}) for f in config.flights if not f.hold_out]
        # Two flights of one log are, without their windows, the same.
        flights = list({(f.log, f.flight): f for f in reversed(kept)}.values())[::-1]
    experiment = experiment._replace(config=config.model_copy(update={"flights": flights}))
    problem = configuration.problem(experiment)
    for flight in problem.flights:
        for note in flight.source.notes if flight.source else ():
            if progress is not None:
                progress(note)
    try:
        ranking = windows(problem, length)
    except ValueError as e:
        raise InputError(f"{path}: {e}") from e
    ranked = {window.flight for window in ranking.windows}
    for i, flight in enumerate(problem.training):
        if i not in ranked and progress is not None:
            words = f"is shorter than a window of {ranking.length:.3g} s, and left out"
            progress(f"{flight.name}: {flight.duration:.4g} s {words}")
    return ranking


def print_ranking(ranking: Ranking) -> None:
    """The windows, best first, and those that are enough together, on standard output."""
    from heli_jax.output import print_table

    taken = [choice.window for choice in ranking.taken]
    rest = [w for w in ranking.windows if not w.excluded and w not in taken]
    # By the geometric mean of the sds, as the D-criterion has it.
    rest.sort(key=lambda w: float(np.sum(np.log(np.minimum(w.sd, 1e3)))))
    rows = [
        (f"{i + 1}", *_of(choice.window), choice.reason) for i, choice in enumerate(ranking.taken)
    ]
    rows += [("", *_of(w), "") for w in rest[: max(_MOST - len(rows), 0)]]
    several = len({w.label for w in ranking.windows}) > 1
    head = ("taken", *(("flight",) if several else ()), "from [s]", "to [s]")
    head += (*(f"sd {n}" for n in ranking.parameters), "why")
    if not several:
        rows = [(row[0], *row[2:]) for row in rows]
    print_table(head, rows)
    unshown = len(rest) - max(_MOST - len(taken), 0)
    if unshown > 0:
        print(f"{unshown} further windows that say less are not shown.")
    for w in ranking.windows:
        if w.excluded:
            print(f"left out: {w.label}, {w.start:.4g} s to {w.end:.4g} s: {w.excluded}")
    last = ranking.taken[-1]
    together = ", ".join(
        f"{n} {_percent(s)} ({_percent(a)})"
        for n, s, a in zip(ranking.parameters, last.sd, ranking.all_sd, strict=True)
    )
    print(
        f"{len(taken)} of {len(ranking.windows)} windows of {ranking.length:.3g} s say "
        f"{100 * last.efficiency:.0f} % of what all say together (at least {100 * ENOUGH:.0f} % "
        f"asked); expected sd of these (of all): {together}. At the start values, from white noise."
    )


def _of(w: Window) -> tuple[str, ...]:
    return (w.label, f"{w.start:.2f}", f"{w.end:.2f}", *(_percent(s) for s in w.sd))


def _percent(sd: float) -> str:
    return f"{100 * sd:.2g} %" if np.isfinite(sd) and sd < 100 else "-"
