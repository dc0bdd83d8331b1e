r"""Instruments: logged excitations added to inputs, which feedback does not affect.

The part of an input that follows them, $\hat U = S_{ur} S_{rr}^{-1} R$, is independent of gusts and
noise. This holds even if a pilot or autopilot feeds both back into the input.

Sources: Söderström and Stoica (1983); Pintelon and Schoukens (2012), chapter 9; Stock and Yogo
(2005) for weak instruments.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.errors import nearest
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight, own_instrument_note, own_instruments
from heli_jax.identification.estimation.frequency_lines import in_time_of, lines_of
from heli_jax.identification.estimation.frequency_noise import once_a_length, smoothed
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data

PART = 0.05
"""sd of the Gaussian that smooths the inputs' spectra, as a fraction of the frequency."""
_ALONE = 1e-9
"""Fraction of the instruments' power below which two of them are dependent."""
STRONG = 16.4
"""F of the inputs' regression on the instruments above which 95 % intervals cover the truth in at
least 90 % of all cases."""


def instruments_of(problem: Problem) -> tuple[str, ...]:
    """Return the inputs replaced by instruments: the configured ones, or all that have one."""
    if problem.instrument is not None:
        return tuple(problem.instrument)
    known = naming.names(problem.model.Inputs)
    own = own_instruments(problem.training, known)
    return tuple(n for n in known if n not in own and _lacks(problem.training, n) is None)


def _lacks(flights: Sequence[Flight], name: str) -> str | None:
    """Return the reason why flights have no instrument of an input, or None."""
    for flight in flights:
        if name not in flight.instruments:
            return f"{flight.name or 'a flight'} holds none (signals.instruments)"
    if not any(np.ptp(f.instruments[name]) > 0 for f in flights):
        return "it moves in no flight"
    return None


def absent_instrument(problem: Problem) -> str | None:
    """Return the reason why a configured instrument cannot be used, or None."""
    known = naming.names(problem.model.Inputs)
    for name in problem.instrument or ():
        if name not in known:
            return (
                f"instrument {name!r}: model {problem.model.name} has no such input"
                f"{nearest(name, known)}"
            )
        why = _lacks(problem.training, name)
        if why is not None:
            return f"instrument of {name}: {why}; expected one in every flight, or instrument: none"
    own = own_instruments(problem.training, problem.instrument or ())
    return own_instrument_note(own) if own else None


def instrumented_inputs(
    problem: Problem, flights: Sequence[Flight]
) -> tuple[dict[str, np.ndarray], ...] | None:
    """Return, by flight and input, its part (N,) that follows the instruments, SI.

    An input without an instrument is returned unchanged. The result is None if no input has one.
    """
    names = instruments_of(problem)
    if not names or any(n not in f.instruments for f in flights for n in names):
        return None
    inputs = [np.stack([f.inputs[n] for n in names], axis=1) for f in flights]
    r = [np.stack([f.instruments[n] for n in names], axis=1) for f in flights]
    return tuple(
        {**f.inputs, **dict(zip(names, columns.T, strict=True))}
        for f, columns in zip(flights, following(inputs, r), strict=True)
    )


def as_instruments_have_it(data: Data) -> Data:
    """Return the flights as if only the instruments moved them, for a direct estimate.

    Inputs are those by instrument; outputs are reduced to the part that follows them. Gusts and
    noise are contained only by chance, without their effect through feedback.
    """
    inputs = [naming.asdict(f.by_instrument) for f in data.flights]
    moving = [n for n in inputs[0] if any(np.ptp(np.asarray(u[n])) > 0 for u in inputs)]
    names = list(data.flights[0].outputs)
    direct = tuple(f._replace(by_instrument=None) for f in data.flights)
    if not moving or any(list(f.outputs) != names for f in data.flights):
        return data._replace(flights=direct)
    outputs = [np.stack([filled(f.outputs[n]) for n in names], axis=1) for f in data.flights]
    made = following(
        outputs, [np.stack([np.asarray(u[n]) for n in moving], axis=1) for u in inputs]
    )
    flights = []
    for f, columns in zip(data.flights, made, strict=True):
        columns = columns.astype(f.outputs[names[0]].dtype)
        by_name = dict(zip(names, columns.T, strict=True))
        flights.append(f._replace(inputs=f.by_instrument, outputs=by_name, by_instrument=None))
    return data._replace(flights=tuple(flights))


def filled(y: Any) -> Float[np.ndarray, " N"]:
    """Return a signal with missing samples interpolated linearly."""
    y = np.asarray(y)
    at, seen = np.arange(y.size), np.isfinite(y)
    return np.interp(at, at[seen], y[seen])


def following(
    of: Sequence[Float[np.ndarray, "N u"]], signals: Sequence[Float[np.ndarray, "N r"]]
) -> list[Float[np.ndarray, "N u"]]:
    """Return, by flight, the part of the columns that follows the signals, around their means."""
    U, R = ([lines_of(v) for v in one] for one in (of, signals))
    u = U[0].shape[1]

    def response(joint: np.ndarray) -> np.ndarray:
        S, with_them = joint[:, u:, u:], joint[:, :u, u:]
        size = np.sqrt(np.real(np.einsum("kii->ki", S)))
        size = np.where(size > 0, size, 1.0)[:, None, :]
        # Coherences are independent of units; two dependent signals share their effect.
        coherence = S / (size.swapaxes(1, 2) * size)
        return with_them / size @ np.linalg.pinv(coherence, rcond=_ALONE, hermitian=True) / size

    spectra = smoothed([np.concatenate(v, axis=1) for v in zip(U, R, strict=True)], PART)
    each = zip(once_a_length(response, spectra), R, strict=True)
    made = [np.einsum("kur,kr->ku", H, lines) for H, lines in each]
    return [in_time_of(v, len(w)) + w.mean(axis=0) for v, w in zip(made, of, strict=True)]


def inputs_by_instrument(data: Data) -> tuple[str, ...]:
    """Return the inputs replaced by their instruments."""
    first = data.flights[0]
    inputs, by = naming.asdict(first.inputs), naming.asdict(first.by_instrument)
    return tuple(n for n in inputs if np.any(np.asarray(inputs[n]) != np.asarray(by[n])))


def instrument_notes(data: Data) -> list[Finding]:
    """Return notes on the limits of an estimate by instrument."""
    if data.flights[0].by_instrument is None:
        return []
    words = (
        f"By instrument ({', '.join(inputs_by_instrument(data))}): the estimates solve equations "
        "and have no likelihood, so there is no AIC or BIC; a profile uses the equations' sum of "
        "squares, which has the same limits."
    )
    return [note("frequency.by-instrument", words, *inputs_by_instrument(data))]
