"""How far a model's response may be from the measured one before a pilot notices: envelopes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Numerators and denominators in s, highest power first: of the gain, and of the phase in degrees
# the argument.
_GAIN = (((0.095, 9.92, 2.15), (1.0, 11.6, 4.95)), ((3.16, 31.61, 22.79), (1.0, 27.14, 1.84)))
_PHASE = (
    ((475.32, 184100.0, 29460.0), (1.0, 11.66, 0.039)),
    ((68.89, 1100.12, -275.22), (1.0, 39.94, 9.99)),
)


class Envelope(NamedTuple):
    """Of measured over modelled, lower and upper limits (k,)."""

    gain_db: tuple[np.ndarray, np.ndarray]
    phase_deg: tuple[np.ndarray, np.ndarray]


def unnoticeable(omega: Float[np.ndarray, " k"]) -> Envelope:
    """Envelopes of maximum unnoticeable added dynamics.

    Pilots of full-size fixed-wing aircraft did not notice added dynamics within them: narrowest
    about 1 to 5 rad/s, wide at low and at high frequencies. They are a measure to look at, no gate.

    Args:
        omega: (k,) [rad/s]

    Source: Wood and Hodgkinson (1980), Definition of acceptable levels of mismatch for equivalent
    systems of augmented CTOL aircraft, MDC A6792, as MIL-STD-1797A and Tischler and Remple (2012)
    have them; the coefficients are those that the function LoesBound of C. Regan (2006, 'based on
    Stoliker's routines') lists, number by number, which itself asks for them to be checked: they
    were not compared with the reports. A lead and a lag of the phase's envelopes by a few
    milliseconds, which some give beside them, are left out, so that these are the narrower ones.
    """
    s = 1j * omega
    gain = [20.0 * np.log10(np.abs(np.polyval(n, s) / np.polyval(d, s))) for n, d in _GAIN]
    phase = [np.degrees(np.angle(np.polyval(n, s) / np.polyval(d, s))) for n, d in _PHASE]
    return Envelope((gain[0], gain[1]), (phase[0], phase[1]))
