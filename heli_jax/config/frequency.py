"""Section `frequency` in terms of the model."""

from collections.abc import Collection, Sequence

from heli_jax import naming, units
from heli_jax.analysis.attitude_responses import HandlingPair, handling_gaps, handling_pairs
from heli_jax.config.experiment import Experiment
from heli_jax.config.frequency_section import FrequencyConfig, HandlingConfig, TransferConfig
from heli_jax.errors import InputError, require_known
from heli_jax.finding import Finding, note


def requested_handling(
    experiment: Experiment, logged: Collection[str] = ()
) -> tuple[HandlingPair, ...]:
    """Return the responses for handling qualities: those configured, or those of the model's axes.

    Raises:
        InputError: the model has no such input or output, or the output is no angle and no rate.
    """
    config = experiment.config.frequency or FrequencyConfig()
    if config.handling is None:
        return handling_pairs(experiment.model, logged)
    check_pairs(experiment, "handling", config.handling)
    unit = units_of(experiment)
    for i, h in enumerate(config.handling):
        if (
            h.response == "open-loop"
            or units.fits(unit[h.output], "rad")
            or units.fits(unit[h.output], "rad/s")
        ):
            continue
        raise InputError(
            f"{experiment.path}: frequency.handling[{i}].output: {h.output} is in "
            f"{unit[h.output]}, expected an angle or an angular rate, since bandwidth and phase "
            "delay are defined for these"
        )
    return tuple(
        HandlingPair(
            h.input,
            h.output,
            h.response,
            integrated=units.fits(unit[h.output], "rad/s") and h.response != "open-loop",
            gain=h.gain,
        )
        for h in config.handling
    )


def missing_handling(experiment: Experiment, logged: Collection[str]) -> tuple[Finding, ...]:
    """Explain why logged axes have no handling qualities, if none are requested by name."""
    config = experiment.config.frequency or FrequencyConfig()
    gaps = handling_gaps(experiment.model, logged) if config.handling is None else ()
    return tuple(note("responses.no-handling", words) for words in gaps)


def check_pairs(
    experiment: Experiment, section: str, pairs: Sequence[TransferConfig | HandlingConfig]
) -> None:
    """Refuse pairs of input and output that the model lacks.

    Args:
        section: their section of `frequency`.

    Raises:
        InputError: one of them is unknown.
    """
    for i, pair in enumerate(pairs):
        for role, record in (
            ("input", experiment.model.Inputs),
            ("output", experiment.model.Outputs),
        ):
            name, known = getattr(pair, role), naming.names(record)
            where = f"{experiment.path}: frequency.{section}[{i}].{role}"
            require_known([name], known, where, f"model {experiment.model.name} has no {role}")


def units_of(experiment: Experiment) -> dict[str, str]:
    """Return SI units of the model's inputs and outputs, by name; 1 if it states none."""
    model = experiment.model
    records = (model.Inputs, model.Outputs)
    return {n: naming.unit(r, n) or "1" for r in records for n in naming.names(r)}
