"""What the section `frequency` asks for, in terms of the model."""

from collections.abc import Collection, Sequence

from heli_jax import naming
from heli_jax.analysis.attitude_responses import HandlingPair, handling_pairs
from heli_jax.config.experiment import Experiment
from heli_jax.config.frequency_section import FrequencyConfig, HandlingConfig, TransferConfig
from heli_jax.errors import InputError, nearest


def asked_handling(
    experiment: Experiment, logged: Collection[str] = ()
) -> tuple[HandlingPair, ...]:
    """Responses whose handling qualities are shown: those that the configuration names, or else
    those of the model's axes.

    Args:
        experiment: the configuration.
        logged: outputs of the flights.

    Raises:
        InputError: the model has no such input or output.
    """
    config = experiment.config.frequency or FrequencyConfig()
    if config.handling is None:
        return handling_pairs(experiment.model, logged)
    check_pairs(experiment, "handling", config.handling)
    units = units_of(experiment)
    return tuple(
        HandlingPair(
            h.input,
            h.output,
            h.response,
            integrated=units[h.output] == "rad/s" and h.response != "open-loop",
            gain=h.gain,
        )
        for h in config.handling
    )


def check_pairs(
    experiment: Experiment, section: str, pairs: Sequence[TransferConfig | HandlingConfig]
) -> None:
    """Refuse pairs of input and output that the model has not.

    Args:
        experiment: the configuration.
        section: of `frequency` that they stand in.
        pairs: as they stand there.

    Raises:
        InputError: one of them.
    """
    for i, wanted in enumerate(pairs):
        for role, record in (
            ("input", experiment.model.Inputs),
            ("output", experiment.model.Outputs),
        ):
            name, known = getattr(wanted, role), naming.names(record)
            if name not in known:
                raise InputError(
                    f"{experiment.path}: frequency.{section}[{i}].{role}: model "
                    f"{experiment.model.name} has no {role} {name!r}{nearest(name, known)}"
                )


def units_of(experiment: Experiment) -> dict[str, str]:
    """SI units of the model's inputs and outputs, by name; 1 where it states none."""
    model = experiment.model
    records = (model.Inputs, model.Outputs)
    return {n: naming.unit(r, n) or "1" for r in records for n in naming.names(r)}
