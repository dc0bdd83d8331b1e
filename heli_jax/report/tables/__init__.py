"""What the report's page says, as words and as rows of text; the page itself is the template."""

from heli_jax.report.tables.agreement import (
    acceptance,
    agreement,
    choice,
    held_out_bands,
    held_out_flights,
    residuals,
    responses,
)
from heli_jax.report.tables.baseline import baseline_facts, baseline_ratios
from heli_jax.report.tables.estimates import (
    Nuisances,
    combinations,
    intervals,
    nuisances,
    parameters,
    prior_note,
    sampling,
    starts,
    verdict,
    where_it_stopped,
)
from heli_jax.report.tables.first_guess import first_guess, selection_steps, start_method
from heli_jax.report.tables.handling import handling, handling_sentences
from heli_jax.report.tables.headline import (
    Headline,
    further_sentences,
    headline,
    model_remark,
    warnings,
)
from heli_jax.report.tables.meanings import meanings
from heli_jax.report.tables.methods import methods
from heli_jax.report.tables.provenance import Origin, constants, origins
from heli_jax.report.tables.table import NOT_DETERMINED, Table, pairs

__all__ = [
    "NOT_DETERMINED",
    "Headline",
    "Nuisances",
    "Origin",
    "Table",
    "acceptance",
    "agreement",
    "baseline_facts",
    "baseline_ratios",
    "choice",
    "combinations",
    "constants",
    "first_guess",
    "further_sentences",
    "handling",
    "handling_sentences",
    "headline",
    "held_out_bands",
    "held_out_flights",
    "intervals",
    "meanings",
    "methods",
    "model_remark",
    "nuisances",
    "origins",
    "pairs",
    "parameters",
    "prior_note",
    "residuals",
    "responses",
    "sampling",
    "selection_steps",
    "start_method",
    "starts",
    "verdict",
    "warnings",
    "where_it_stopped",
]
