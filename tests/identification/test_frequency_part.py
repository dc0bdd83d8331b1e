"""The lowest frequencies alone, where a search in frequency begins: when, and where it ends."""

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import fit
from heli_jax.identification.estimation import frequency_error
from heli_jax.identification.estimation.evaluation import least_share
from heli_jax.identification.estimation.frequency_lines import blocks_of
from heli_jax.identification.estimation.frequency_records import Record
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.estimation.multistart import Search, first_optima
from heli_jax.identification.search import first_guess


def test_blocks_hold_all_lines_and_a_quarter_of_them_is_whole_blocks():
    for N in (50, 514, 6001):
        blocks = blocks_of(Record(0, 7, 7 + N), jnp.asarray(0.25), 60)
        K = (N - 1) // 2
        v = np.arange(2 * K).reshape(2, K) + 1.0
        cut = blocks.cut(jnp.asarray(v), axis=1)
        np.testing.assert_array_equal(blocks.joined(cut, axis=1), v)
        assert np.sum(np.asarray(cut)) == np.sum(v)
        used = np.stack([np.asarray(blocks.within(b)) for b in range(blocks.count)])
        assert used.sum() == K // 4
        assert blocks.count == 1 or blocks.count % 4 == 0
        seen = blocks.over(lambda b, total, cut=cut: total + jnp.sum(cut[b]), jnp.zeros(()))
        lines = used.any(axis=1)[:, None, None] if blocks.count > 1 else True
        assert float(seen) == np.sum(np.where(lines, np.asarray(cut).swapaxes(1, 2), 0.0))


def test_the_least_share_is_that_of_the_worst_combination():
    rng = np.random.default_rng(0)
    J = rng.standard_normal((40, 3)) * np.array([1.0, 1e6, 1e-5])
    part = J[:25]
    values = np.linalg.eigvals(np.linalg.solve(J.T @ J, part.T @ part))
    assert least_share(part, J) == pytest.approx(np.min(values.real), rel=1e-6)
    # A column without any effect is told of by neither.
    none = np.zeros((40, 1))
    more, of_part = np.hstack([J, none]), np.hstack([part, none[:25]])
    assert least_share(of_part, more) == pytest.approx(np.min(values.real), rel=1e-6)
    assert least_share(np.full((2, 3), np.nan), J) == 0.0


def test_a_search_that_begins_with_a_quarter_ends_where_it_does_with_all(
    by_lines, fitted_by_lines, monkeypatch
):
    guess = first_guess(by_lines)
    search = Search(by_lines, guess.layout, guess.data, 200)
    assert float(first_optima(search, guess, lambda *_: guess.z[None]).noise.part) == 1.0
    monkeypatch.setattr(frequency_error, "_MANY", 0)
    assert float(first_optima(search, guess, lambda *_: guess.z[None]).noise.part) == 0.25
    quick = fit(by_lines)
    assert quick.status == fitted_by_lines.status == "converged"
    assert float(quick.reached.noise.part) == 1.0
    for name, one in fitted_by_lines.estimates.items():
        other = quick.estimates[name]
        assert abs(other.value - one.value) < 0.05 * one.sd
        assert other.sd == pytest.approx(one.sd, rel=0.02)
    assert quick.log_likelihood == pytest.approx(fitted_by_lines.log_likelihood, abs=0.3)


def test_where_a_quarter_tells_less_all_lines_are_used(by_lines, monkeypatch):
    guess = first_guess(by_lines)
    few = guess.noise._replace(part=np.asarray(0.25))
    at = residual_and_jacobian(guess.layout, guess.data, few, guess.z)
    q = len(guess.layout.of_interest)
    share = least_share(np.asarray(at.J)[:, :q], np.asarray(guess.e.J)[:, :q])
    assert 0.5 < share < 1.0
    monkeypatch.setattr(frequency_error, "_MANY", 0)
    monkeypatch.setattr(frequency_error, "_NEARLY_ALL", share + 1e-6)
    search = Search(by_lines, guess.layout, guess.data, 200)
    assert first_optima(search, guess, lambda *_: guess.z[None]).noise is guess.noise


def test_what_a_quarter_does_not_find_is_sought_with_all(by_lines, fitted_by_lines, monkeypatch):
    monkeypatch.setattr(frequency_error, "_MANY", 0)
    run, parts = Search.run, []

    def failing(self, noise, points, *args, **more):
        parts.append(float(noise.part))
        made = run(self, noise, points, *args, **more)
        if noise.part < 1.0:
            made = [o._replace(z=points[0] + 3.0, converged=np.asarray(False)) for o in made]
        return made

    monkeypatch.setattr(Search, "run", failing)
    found = fit(by_lines)
    assert parts[:2] == [0.25, 1.0]
    for name, one in fitted_by_lines.estimates.items():
        assert abs(found.estimates[name].value - one.value) < 0.05 * one.sd
