"""What is said beside a transfer function, in terminal, page and JSON alike."""

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
    ("fit", "words"),
    [
        (_fit(2.0), []),
        (_fit(2.0, -0.38), ["a pole of 0.17 1/s is not forgotten", "integrator"]),
        (_fit(5.0, -24.0), ["a pole of 3 1/s is not forgotten"]),
        (_fit(2.0, chi_squared=3.0), ["3 times what the random errors let expect"]),
        (_fit(2.0, converged=False), ["no result"]),
    ],
)
def test_what_is_to_be_heeded_of_a_transfer_function(fit: TransferFit, words: list[str]) -> None:
    said = " ".join(fit_sentences(fit, WINDOW))
    assert bool(said) == bool(words)
    assert all(w in said for w in words)
    assert ("integrator" in said) == ("integrator" in words)
