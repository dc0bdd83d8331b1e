"""`heli-jax windows`: which parts of a log say most of what a configuration has free."""

from collections.abc import Callable

import numpy as np

from heli_jax import config as configuration
from heli_jax.config import Experiment
from heli_jax.config.logs import require_flights, with_log
from heli_jax.errors import located
from heli_jax.identification.design.accuracy import GUESSED
from heli_jax.identification.design.windows import (
    DETERMINES,
    ENOUGH,
    Ranking,
    Window,
    window_samples,
)
from heli_jax.identification.fit import windows
from heli_jax.stages import Note
from heli_jax.terminal import print_table, tell

_MOST = 40
"""windows in the table; those that were taken are always in it"""


def rank_log(
    experiment: Experiment,
    log: str | None = None,
    length: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Ranking:
    """Rank the windows of a configuration's logs by their information on its free parameters.

    Args:
        experiment: the configuration; windows that it states for its flights are left out of
            account, and what it holds out is not ranked.
        length: of a window [s].

    Raises:
        InputError: the log or something of the configuration is wrong, or no window may be used.
    """
    config, path = experiment.config, experiment.path
    require_flights(experiment)
    if log is not None:
        flights = list(with_log(experiment, log).config.flights)
    else:
        kept = [f.model_copy(update={"window": None}) for f in config.flights if not f.hold_out]
        # Two flights of one log are, without their windows, the same.
        flights = list({(f.log, f.flight): f for f in reversed(kept)}.values())[::-1]
    experiment = experiment._replace(config=config.model_copy(update={"flights": flights}))
    problem = configuration.problem(experiment)
    for flight in problem.flights:
        for found in flight.source.notes if flight.source else ():
            progress(Note(found.sentence))
    with located(f"{path}"):
        # Before the work, and not after it: with many windows that takes a while.
        seconds = window_samples(problem, length) * problem.training[0].dt
        progress(f"comparing windows of {seconds:.3g} s, side by side")
        return windows(problem, length)


def print_ranking(ranking: Ranking) -> None:
    """The windows, best first, and those that are enough together, on standard output."""

    if cannot_be_fitted(ranking):
        # What a window expects of a model that the samples cannot show is no recommendation.
        _print_doubts(ranking)
        tell(f"No window of {ranking.length:.3g} s is recommended.")
        return
    taken = [choice.window for choice in ranking.taken]
    rest = [w for w in ranking.windows if not w.excluded and w not in taken]
    # By the geometric mean of the sds, as the D-criterion has it.
    rest.sort(key=lambda w: float(np.sum(np.log(np.minimum(w.sd, 1e3)))))
    rows = [(f"{i + 1}", *_of(window)) for i, window in enumerate(taken)]
    rows += [("", *_of(w)) for w in rest[: max(_MOST - len(rows), 0)]]
    several = len({w.label for w in ranking.windows}) > 1
    head = ("taken", *(("flight",) if several else ()), "from [s]", "to [s]")
    head += tuple(f"sd {n}" for n in ranking.parameters)
    if not several:
        rows = [(row[0], *row[2:]) for row in rows]
    print_table(head, rows, keys=head.index("to [s]") + 1)
    unshown = len(rest) - max(_MOST - len(taken), 0)
    if unshown > 0:
        tell(f"windows that say less, not shown: {unshown}")
    for w in ranking.windows:
        if w.excluded:
            tell(f"left out: {w.label}, {w.start:.4g} s to {w.end:.4g} s: {w.excluded}")
    last = ranking.taken[-1]
    together = ", ".join(
        f"{n} {_percent(s)} ({_percent(a)})"
        for n, s, a in zip(ranking.parameters, last.sd, ranking.all_sd, strict=True)
    )
    tell(
        f"{len(taken)} of {len(ranking.windows)} windows of {ranking.length:.3g} s say "
        f"{100 * last.efficiency:.0f} % of what all say together (at least {100 * ENOUGH:.0f} % "
        f"asked); expected sd of these (of all): {together}. At the start values, from white noise."
    )
    _print_doubts(ranking)


def cannot_be_fitted(ranking: Ranking) -> bool:
    """True if no part of the log has any information on what is asked."""
    return any(f.severity == "refuse" for f in ranking.record)


def not_determined(ranking: Ranking) -> tuple[str, ...]:
    """The parameters that all windows together do not determine."""
    pairs = zip(ranking.parameters, ranking.all_sd, strict=True)
    return tuple(n for n, sd in pairs if not sd < DETERMINES)


def _print_doubts(ranking: Ranking) -> None:
    """Print the assumptions of a ranking, and the doubts about the record."""
    for finding in ranking.record:
        tell(f"{'x' if finding.severity == 'refuse' else '!'} {finding.topic}: {finding.sentence}")
    for name in ranking.guessed:
        tell(f"noise of {name}: {ranking.noise[name]:.3g} ({GUESSED})")
    for found in ranking.notes:
        tell(f"! {found.sentence}")
    if names := not_determined(ranking):
        whole = "The whole record does" if set(names) <= set(ranking.undetermined) else "All do"
        tell(f"! {whole} not determine {', '.join(names)}; heli-jax check says why.")


def _of(w: Window) -> tuple[str, ...]:
    return (w.label, f"{w.start:.2f}", f"{w.end:.2f}", *(_percent(s) for s in w.sd))


def _percent(sd: float) -> str:
    return f"{100 * sd:.2g} %" if np.isfinite(sd) and sd < DETERMINES else "-"
