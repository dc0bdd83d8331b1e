"""Doubts about a record that no residual shows: sampling too slow, inputs too small or too few."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.analysis.linear import modes
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.operating_point import operating_point

_AT_NYQUIST = 0.9
_FEEBLE = 3.0


def notes(problem: Problem, simulated: tuple[dict[str, np.ndarray], ...], sd: Any) -> list[str]:
    """Sentences on sampling and excitation for runs simulated at the start values."""
    found = sampling(problem, {n: f.start for n, f in problem.free.items()})
    for flight, outputs, noise in zip(problem.training, simulated, sd, strict=True):
        where = flight.name or "the flight"
        for name, y in outputs.items():
            moved = float(np.std(y))
            if moved < _FEEBLE * float(noise[name]):
                found.append(
                    f"{where}: the input hardly excites the model: it moves {name} by "
                    f"{moved:.2g} (rms, at the start values) where the noise is "
                    f"{float(noise[name]):.2g}; use larger or more inputs."
                )
        changes = sum(int(np.count_nonzero(np.diff(u))) for u in flight.inputs.values())
        if changes < len(problem.free):
            names = " and ".join(flight.inputs)
            found.append(
                f"{where}: {names} {'change' if len(flight.inputs) > 1 else 'changes'} {changes} "
                f"times in the record, fewer than there are free parameters "
                f"({len(problem.free)}): it excites too little."
            )
    return found


def sampling(problem: Problem, values: dict[str, float]) -> list[str]:
    """A sentence for each flight whose sampling a mode of the linearised model reaches."""
    free = {n: jnp.asarray(v) for n, v in values.items() if n in problem.free}
    params = naming.replace(problem.vehicle, **free)
    found = []
    for flight in problem.training:
        known = {n: jnp.asarray(v) for n, v in flight.known.items()}
        here = naming.replace(params, **known)
        at = operating_point(
            problem.model, here, flight.inputs, flight.outputs, flight.dt, substeps=problem.substeps
        )
        try:
            eigenvalues = modes(problem.model, here, at.state, at.inputs)
        except np.linalg.LinAlgError:  # no finite matrices there: nothing is known of the modes
            continue
        fastest = float(np.max(np.abs(np.imag(eigenvalues))))
        nyquist = np.pi / flight.dt
        if fastest >= _AT_NYQUIST * nyquist:
            past = fastest >= nyquist
            found.append(
                f"{flight.name or 'the flight'}: a mode at {fastest:.4g} rad/s"
                f"{f' (linearised about {at.words})' if at.words else ''} lies "
                f"{'at or past' if past else 'near'} the Nyquist frequency of the sampling "
                f"({nyquist:.4g} rad/s): the samples {'cannot' if past else 'hardly'} show it, and "
                "its aliases may be taken for slower dynamics."
            )
    return found
