"""Sentences about a transfer function in terminal, page and JSON."""

import pytest

from heli_jax.analysis.transfer_fit import Coefficient, TransferFit
from heli_jax.report.responses import fit_sentences

WINDOW = 20.0


def _fit(*denominator: float, chi_squared: float = 1.0, converged: bool = True) -> TransferFit:
    def known(value: float) -> Coefficient:
        return Coefficient(value, 0.1, value - 0.2, value + 0.2)

    below = tuple(known(v) for v in denominator)
    return TransferFit((known(10.0),), below, None, chi_squared, 5.0, converged)


@pytest.mark.parametrize(
    ("fit", "sentences"),
    [
        (_fit(2.0), 0),
        (_fit(2.0, -0.38), 2),  # a growing pole, slower than the window
        (_fit(2.0, chi_squared=3.0), 1),
        (_fit(2.0, converged=False), 1),
    ],
)
def test_what_is_to_be_heeded_of_a_transfer_function(fit: TransferFit, sentences: int) -> None:
    assert len(fit_sentences(fit, WINDOW)) == sentences
