from heli_jax.identification.uncertainty.estimates import delay_findings
from heli_jax.identification.validation.aliases import aliasing, measurement_noise
from heli_jax.identification.validation.late_inputs import late_angles, late_inputs
from heli_jax.identification.validation.late_stick import late_stick, slow_sticks
from heli_jax.identification.validation.logging_rate import logging_rate, loop_between_samples
from heli_jax.identification.validation.other_hold import other_hold


def _late(c):
    free = c.at.layout.shift or set(c.problem.model.delay_parameters) & set(c.problem.free)
    yield from late_angles(c.problem) if not c.fitted else ()
    if c.fitted and (
        free or not (c.at.layout.estimator.noise_spectrum or not (c.arrived and c.explains))
    ):
        return
    yield from late_inputs(c.flights, c.feedback)


def _stick(c):
    if c.arrived and c.explains and not c.instruments:
        named = {n: (x.value, x.sd) for n, x in c.estimates.items()}
        told = {x.kind for x in c.unmodelled[0]}
        for f in late_stick(c.problem, c.at, c.e, named):
            if not (f.code == "dynamics.residual-follows-input" and "input" in told):
                yield f
    if not c.fitted:
        yield from slow_sticks(c.problem, c.at, c.e, skip=c.undetermined)


def _rate(c):
    noise = measurement_noise(c.problem, c.at.noise.sd) if c.fitted else c.at.noise.sd
    yield from logging_rate(c.problem, c.flights, noise, c.params if c.fitted else None)


def _between(c):
    for f in loop_between_samples(c.flights, c.feedback):
        yield f._replace(distrusts=tuple(c.estimates))


def _hold(c):
    if not c.fitted:
        yield from other_hold(c.problem, c.at, c.e, skip=c.undetermined)
    elif c.arrived:
        yield from other_hold(
            c.problem,
            c.at,
            c.e,
            {n: x.sd for n, x in c.estimates.items() if x.sd is not None},
            in_doubt=True,
        )


DIAGNOSTICS = (
    _late,
    _stick,
    _between,
    lambda c: aliasing(c.fast_modes),
    _rate,
    _hold,
    lambda c: delay_findings(c.problem, c.estimates),
)
