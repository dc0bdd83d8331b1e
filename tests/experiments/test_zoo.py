"""One of each kind of the hundred problems with known answers."""

import runpy
from pathlib import Path

import pytest

from heli_jax import fit

ZOO = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "zoo.py"))
KINDS = {kind.__name__: kind for kind, _ in (*ZOO["SOUND"], *ZOO["UNSOUND"])}


@pytest.fixture(autouse=True)
def _from_anywhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def test_there_are_a_hundred_and_half_are_sound():
    assert sum(count for _, count in ZOO["SOUND"]) == 50
    assert sum(count for _, count in ZOO["UNSOUND"]) == 50


# In short runs: other tests or the ten cases of the corpus cover the rest.
SLOW = {
    "with_prior", "total", "gain_nuisance", "two_inputs", "product", "plain", "something_else",
    "swapped_sign", "alike_inputs", "short_period", "constant_known_bias", "on_the_stand",
}  # fmt: skip


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.slow if name in SLOW else (), id=name)
        for name, kind in KINDS.items()
    ],
)
def test_no_silent_success_and_no_false_alarm(kind):
    puzzle = kind(0)
    assert not ZOO["complaint"](puzzle, fit(puzzle.problem))
