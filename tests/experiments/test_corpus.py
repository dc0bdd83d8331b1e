"""Ten cases of the corpus against their stored results, and the definition of a difference."""

import importlib
import json
import sys
from pathlib import Path

import pytest

from heli_jax.identification.diagnostics import context

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def corpus():
    before = list(sys.path)
    sys.path.insert(0, str(EXPERIMENTS))
    yield importlib.import_module("corpus")
    sys.path[:] = before


def test_ten_cases_are_as_they_were_stored(corpus):
    if not corpus.STORED.exists():
        pytest.skip("tests/reference/corpus.json is not stored yet")
    shared = corpus.shared_folder(None)
    cases = importlib.import_module("corpus_cases").cases(shared)
    chosen = [c for c in cases if c.quick]
    assert len(chosen) == 10
    stored = json.loads(corpus.STORED.read_text(encoding="utf-8"))
    assert corpus.compare(stored, corpus.run_all(chosen, shared, 1)) == []


def test_differences_are_those_that_count(corpus):
    codes = {"doubt": ["a"], "note": ["b"]}
    one = {"exit": 0, "status": "converged", "adequate": True, "codes": codes}
    one |= {"estimates": {"Lp": [-4.0, 0.1, -4.2, -3.8]}, "numbers": {"rate": 50.0, "rows": 10}}

    def count(**changes):
        return len(list(corpus.differences(one, one | changes)))

    assert count(cpu=3.0, log_likelihood=1.0) == 0
    assert count(exit=3) == count(adequate=False) == count(status="not-converged") == 1
    assert count(estimates={"Lp": [-4.009, 0.104, 0, 0]}) == 0
    assert count(estimates={"Lp": [-4.011, 0.1, 0, 0]}) == 1
    assert count(estimates={"Lp": [-4.0, 0.106, 0, 0]}) == 1
    assert count(estimates={"Lp": [-4.0, None, None, None]}) == 1
    assert count(estimates={}) == 1
    assert count(numbers={"rate": 50.01, "rows": 10}) == 0
    assert count(numbers={"rate": 51.0}) == 2
    # A code that changes its rank counts twice, as one removed and one added.
    assert count(codes={"exit": ["a"], "note": ["b"]}) == 2
    assert count(skipped="absent") == 0


def test_a_key_of_a_sentence_has_no_numbers_and_no_names(corpus):
    words = "flight 2: Lp and Lda moved by 1.5 % (3.2e-4): see 'x.csv' at runs/a/b.csv."
    assert corpus.code_of(words, ["flight 2", "Lp", "Lda"]) == "_ moved by # % (#): see _ at _"
    assert corpus.code_of({"code": "timing.input-late", "sentence": words}) == "timing.input-late"


def test_a_candidate_is_replaced_everywhere(corpus):
    matrix = importlib.import_module("corpus_matrix")
    original = context.second_solutions
    for one in matrix.ABLATIONS:
        with matrix.replaced(one.entry, lambda _: None):
            assert (context.second_solutions is None) == (one.name == "swapped_modes")
    assert context.second_solutions is original
