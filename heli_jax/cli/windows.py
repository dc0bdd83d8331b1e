"""`heli-jax windows`: the most informative parts of a log for the free parameters."""

from collections.abc import Callable

import numpy as np

from heli_jax import config as configuration
from heli_jax.cli.terminal import print_table, print_text
from heli_jax.config import Experiment
from heli_jax.config.logs import log_notes, require_flights, with_log
from heli_jax.errors import located
from heli_jax.identification.design.accuracy import DETERMINES, GUESSED
from heli_jax.identification.design.windows import (
    ENOUGH,
    Ranking,
    Window,
    window_samples,
)
from heli_jax.identification.fit import windows
from heli_jax.stages import Note

_MOST = 40
"""Most windows in the table; the selected ones are always shown."""


def rank_log(
    experiment: Experiment,
    log: str | None = None,
    length: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Ranking:
    """Rank the windows of a configuration's logs by their information on its free parameters.

    Args:
        experiment: the configuration; windows of its flights are ignored, and flights held out are
            not ranked.
        length: length of a window [s].

    Raises:
        InputError: the log or the configuration is wrong, or no window is usable.
    """
    config, path = experiment.config, experiment.path
    require_flights(experiment)
    if log is not None:
        flights = list(with_log(experiment, log).config.flights)
    else:
        kept = [f.model_copy(update={"window": None}) for f in config.flights if not f.hold_out]
        # Without their windows, two flights of one log are the same.
        flights = list({(f.log, f.flight): f for f in reversed(kept)}.values())[::-1]
    experiment = experiment._replace(config=config.model_copy(update={"flights": flights}))
    problem = configuration.problem(experiment)
    for found in log_notes(problem.flights):
        progress(Note(found.sentence))
    with located(f"{path}"):
        # Report before the comparison, which may take long.
        seconds = window_samples(problem, length) * problem.training[0].dt
        progress(f"comparing windows of {seconds:.3g} s, side by side")
        return windows(problem, length)


def print_ranking(ranking: Ranking) -> None:
    """Print the windows, best first, and the set that suffices, on standard output."""

    if cannot_be_fitted(ranking):
        # If the samples cannot show the model's modes, its predictions recommend no window.
        _print_doubts(ranking)
        print_text(f"No window of {ranking.length:.3g} s is recommended.")
        return
    taken = [choice.window for choice in ranking.taken]
    rest = [w for w in ranking.windows if not w.excluded and w not in taken]
    # Sort by the geometric mean of the sds, as the D-criterion does.
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
        print_text(f"less informative windows, not shown: {unshown}")
    for w in ranking.windows:
        if w.excluded:
            print_text(f"left out: {w.label}, {w.start:.4g} s to {w.end:.4g} s: {w.excluded}")
    last = ranking.taken[-1]
    together = ", ".join(
        f"{n} {_percent(s)} ({_percent(a)})"
        for n, s, a in zip(ranking.parameters, last.sd, ranking.all_sd, strict=True)
    )
    print_text(
        f"{len(taken)} of {len(ranking.windows)} windows of {ranking.length:.3g} s give "
        f"{100 * last.efficiency:.0f} % of the accuracy of all together (at least "
        f"{100 * ENOUGH:.0f} % required); expected sd with these (with all): {together}. At the "
        "start values, for white noise."
    )
    _print_doubts(ranking)


def cannot_be_fitted(ranking: Ranking) -> bool:
    """True if no part of the log has information on the free parameters."""
    return any(f.severity == "refuse" for f in ranking.record)


def not_determined(ranking: Ranking) -> tuple[str, ...]:
    """Return the parameters that all windows together do not determine."""
    pairs = zip(ranking.parameters, ranking.all_sd, strict=True)
    return tuple(n for n, sd in pairs if not sd < DETERMINES)


def _print_doubts(ranking: Ranking) -> None:
    """Print the assumptions of a ranking, and doubts about the record."""
    for finding in ranking.record:
        print_text(
            f"{'x' if finding.severity == 'refuse' else '!'} {finding.topic}: {finding.sentence}"
        )
    for name in ranking.guessed:
        print_text(f"noise of {name}: {ranking.noise[name]:.3g} ({GUESSED})")
    for found in ranking.notes:
        print_text(f"! {found.sentence}")
    if names := not_determined(ranking):
        whole = "The whole record does" if set(names) <= set(ranking.undetermined) else "All do"
        print_text(f"! {whole} not determine {', '.join(names)}; see heli-jax check.")


def _of(w: Window) -> tuple[str, ...]:
    return (w.label, f"{w.start:.2f}", f"{w.end:.2f}", *(_percent(s) for s in w.sd))


def _percent(sd: float) -> str:
    return f"{100 * sd:.2g} %" if np.isfinite(sd) and sd < DETERMINES else "-"
