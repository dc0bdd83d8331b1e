"""An unstable model whose residual follows the inputs: moved by feedback, or a wrong optimum."""

from types import SimpleNamespace
from typing import Any

import pytest

from heli_jax.identification.validation import excitation_test
from heli_jax.identification.validation.excitation_test import (
    FOLLOWS,
    WRONG_OPTIMUM,
    Followed,
    by_excitation,
)
from heli_jax.identification.validation.metrics import NO_METRICS


@pytest.mark.parametrize(("explained", "code"), [(0.95, FOLLOWS), (0.85, WRONG_OPTIMUM)])
def test_who_holds_a_machine_is_asked_where_the_model_explains_nearly_all(
    monkeypatch: pytest.MonkeyPatch, explained: float, code: str
) -> None:
    # The R-50 in closed loop: feedback moves the speed's derivatives, 93 to 99 % are explained.
    followed = {"p": Followed(1e-20, 0.99), "q": Followed(1e-30, explained)}
    monkeypatch.setattr(excitation_test, "residual_against_excitation", lambda *_: followed)
    estimator = SimpleNamespace(noise_spectrum=True, fits_responses=False)
    flight = SimpleNamespace(by_instrument=None)
    layout = SimpleNamespace(estimator=estimator, of_interest=("Mu",))
    at: Any = SimpleNamespace(layout=layout, data=SimpleNamespace(flights=[flight]))
    left = NO_METRICS._replace(vaf=-1e6)
    problem: Any = None
    found = by_excitation(problem, at, {"p": left, "q": left})
    assert found is not None
    assert found.denied
    assert (found.findings[0].code, found.findings[0].distrusts) == (code, ("Mu",))
