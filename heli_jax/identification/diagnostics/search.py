"""Findings on the search of a fit, and on bounds, priors and logs."""

from collections.abc import Iterator

from heli_jax.finding import Finding, found
from heli_jax.flights.flight import labels
from heli_jax.identification.diagnostics.context import Context

STOPPED = "search.stopped"
FAR = 3.0
"""Distance from a prior's mean at which an estimate contradicts it [sd of the prior]."""


def at_bound(c: Context) -> Iterator[Finding]:
    """Find estimates at their bounds, which the data contradict."""
    for name, estimate in c.estimates.items():
        if estimate.at_bound:
            value = estimate.value
            yield found("fit.at-bound", "doubt", name, value=value, distrusts=c.estimates)


def search_stopped(c: Context) -> Iterator[Finding]:
    """Find a search that did not converge."""
    # Rounding has its own finding and remedy.
    if c.optimum is not None and not (c.at_optimum or c.rounding):
        yield found(STOPPED, "doubt", value=float(sum(s for s, _ in c.optimum.trace)))


def search_notes(c: Context) -> Iterator[Finding]:
    """Report notes of the search and of the method on the optimum."""
    if c.optimum is not None:
        names = [label for label, _ in c.flights]
        yield from c.optimum.notes
        yield from c.at.layout.objective.findings(c.at, c.e, names, c.rounding)


def prior_contradicted(c: Context) -> Iterator[Finding]:
    """Find estimates far from their priors."""
    for name, free in c.problem.free.items() if c.fitted else ():
        if free.prior is not None:
            away = abs(c.estimates[name].value - free.prior.mean) / free.prior.sd
            if away > FAR:
                yield found(
                    "fit.prior-contradicted",
                    "doubt",
                    name,
                    value=away,
                    distrusts=(name,),
                    limit=FAR,
                )


def profile_intervals(c: Context) -> Iterator[Finding]:
    """Report intervals by the profile likelihood."""
    if c.fitted and c.errors.limits:
        yield found("uncertainty.profile-interval", "note", *c.errors.limits)


def band_unused(c: Context) -> Iterator[Finding]:
    """A stated band of frequencies that the method of the fit ignores."""
    objective, band = c.at.layout.objective, c.problem.frequency.band
    if band is not None and objective.noise_model == "spectrum" and not objective.fits_responses:
        yield found("frequency.band-unused", "note", low=band[0], high=band[1])


def log_cautions(c: Context) -> Iterator[Finding]:
    """Report cautions of the logs on signals that bias a fit, each sentence once."""
    by_sentence: dict[str, Finding] = {}
    flights = tuple(c.problem.flights)
    for label, flight in zip(labels(flights), flights, strict=True):
        for caution in flight.source.cautions if flight.source else ():
            by_sentence.setdefault(caution.sentence, caution.of(label))
    yield from by_sentence.values()
