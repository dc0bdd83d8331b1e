from heli_jax.identification.validation.misread import dropouts
from heli_jax.identification.validation.signal_quality import (
    quantisation,
    saturation,
    smoothed,
    strays,
    stuck,
    cut_off,
)


def _all(c):
    yield from dropouts(c.problem, [f.facts for _, f in c.flights])
    if c.fitted:
        yield from cut_off([(n, f.facts) for n, f in c.flights])
    else:
        yield from saturation(c.flights)
        yield from stuck(c.flights)
    yield from strays(c.flights)
    yield from quantisation(c.flights, c.at.noise.sd)
    yield from smoothed(c.flights, process_noise=c.at.layout.estimator.process_noise)


DIAGNOSTICS = (_all,)
