from heli_jax.finding import Finding
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.validation.misread import (
    doubtful_inputs,
    misread,
    scaled_by,
)
from heli_jax.identification.validation.signal_signs import (
    RATE_SCALE,
    against_start,
    rate_against_angle,
    sticks_of,
)


def _all(c):
    at_start = (c.flights, c.start.simulated, sticks_of(c.problem.model))
    for f in misread(c.problem):
        yield f
    for f in rate_against_angle(c.problem):
        if c.fitted and f.code == RATE_SCALE and c.status != "not-converged":
            f = f._replace(distrusts=tuple(c.estimates))
        yield f
    for f in doubtful_inputs(*at_start):
        if c.fitted and c.status != "not-converged":
            f = f._replace(distrusts=scaled_by(c.at, f.subjects[0]))
        yield f
    if not c.fitted or c.adequacy.denied:
        yield from against_start(*at_start)


def _turned(c):
    return sign_notes(c.problem, c.estimates) if c.arrived else []


_NEAR_ZERO = 0.2


def sign_notes(problem, estimates):
    """Doubt about parameters that surely have the other sign than they began with, where they began
    with a value and not next to zero: a turned signal fits as well, and the start alone tells.

    One whose sign is declared (`Model.positive`, `sign: keep`, bounds) cannot turn.

    Args:
        problem: with the starts.
        estimates: by name.
    """
    turned = {}
    for name, free in problem.free.items():
        e = estimates[name]
        # A delay says by itself what it means to be negative.
        if name in problem.model.delay_parameters or e.lower95 is None or e.upper95 is None:
            continue
        surely = e.lower95 * e.upper95 > 0 and e.value * free.start < 0
        if surely and abs(free.start) > _NEAR_ZERO * abs(e.value):
            turned[name] = f"{name} ({free.start:.3g} to {e.value:.3g})"
    if not turned:
        return []
    words = (
        f"{listed(list(turned.values()))} ended with the other sign than the start's: "
        "where that sign is known, an input or an output has the wrong one in the log, or an axis "
        "points the other way (`invert: true`)."
    )
    return [Finding("signs.turned-from-start", "doubt", words, subjects=tuple(turned))]


DIAGNOSTICS = (_all, _turned)
