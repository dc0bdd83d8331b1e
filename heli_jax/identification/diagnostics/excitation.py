from heli_jax.identification.validation.excited_band import NOTHING, NOTHING_FOLLOWS, bands
from heli_jax.identification.validation.aliases import _feeble, _few_changes
from heli_jax.identification.validation.next_flight import missing_outputs, next_flight
from heli_jax.identification.validation.expected_accuracy import guessed_gusts
from heli_jax.identification.validation.excitation_test import outputs_against_excitation


def _bands(c):
    if c.fitted and c.status == "converged" and not c.adequacy.denied:
        return
    for f in bands(c.problem.training):
        if f.code == NOTHING_FOLLOWS and not c.fitted and f.value is not None and f.value < NOTHING:
            p = outputs_against_excitation(c.problem)
            if not p or min(p.values()) >= 0.1 or c.follows:
                f = f._replace(severity="refuse")
        yield f


def _check(c):
    if c.fitted:
        return
    for (_, flight), y, sd in zip(c.flights, c.start.simulated, c.at.noise.sd, strict=True):
        yield from _feeble(flight, y, sd)
        yield from _few_changes(flight, len(c.problem.free))
    yield from guessed_gusts(c.problem, c.at)
    yield from missing_outputs(c.problem, c.at)
    yield from next_flight(c.problem, c.at, c.e)


DIAGNOSTICS = (_bands, _check)
