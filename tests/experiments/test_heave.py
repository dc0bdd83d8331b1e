"""All parameters of the whole helicopter from six two-second records."""

import runpy
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def heave():
    path = Path(__file__).parents[2] / "experiments" / "heave_separates_a.py"
    return runpy.run_path(str(path))


def errors(heave, found):
    truth = heave["vehicle"]()
    return {
        n: (e.value - float(getattr(truth, n))) / e.sd
        for n, e in found.estimates.items()
        if e.sd is not None
    }


def test_nine_parameters_are_recovered_with_throttle(heave):
    found = heave["identify"](heave["records"](0.03))
    assert found.status == "converged"
    assert set(found.estimates) == set(heave["FREE"])
    off = errors(heave, found)
    assert len(off) == 9
    assert max(abs(e) for e in off.values()) < 4
    a = found.estimates["a"]
    assert a.value == pytest.approx(6.0, rel=0.03)
    assert a.sd < 0.02 * 6.0


def test_without_throttle_the_pair_is_named(heave):
    found = heave["identify"](heave["records"](0.002))
    assert max(abs(e) for e in errors(heave, found).values()) < 4
    pairs = {frozenset((p.first, p.second)) for p in found.verdict.pairs}
    assert "Ir * K_throttle is determined far better" in found.verdict.text or (
        frozenset(("Ir", "K_throttle")) in pairs
    )
