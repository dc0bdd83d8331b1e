"""Traced programs that are kept: the same numbers, and never those of something else."""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import models
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.numerics.stored import keep_in, stored
from heli_jax.numerics.stored_content import Unknown, content

traced = []
X = np.linspace(1.0, 2.0, 5)


class Settings(NamedTuple):
    power: float
    model: Any = None


def powers(settings, x):
    traced.append(settings)
    y = x**settings.power
    triangle = jnp.linalg.qr(jnp.outer(y, y) + jnp.eye(5, dtype=y.dtype))[1]
    return {"a": y, "b": (jnp.sum(y), None, [triangle])}


@pytest.fixture
def folder(tmp_path):
    traced.clear()
    keep_in(tmp_path / "kept")
    yield tmp_path / "kept"
    keep_in(None)


def alike(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    return all(map(np.array_equal, jax.tree.leaves(a), jax.tree.leaves(b)))


def kept(folder):
    return len(list(folder.iterdir())) if folder.exists() else 0


# Each `stored` begins with nothing in memory, as a process does.
def test_another_process_runs_what_one_has_traced(folder):
    plain = eqx.filter_jit(powers)(Settings(3.0), X)
    assert alike(stored(powers)(Settings(3.0), X), plain)
    traced.clear()
    assert alike(stored(powers)(Settings(3.0), X), plain)
    assert not traced
    assert kept(folder) == 1
    # What it returns is of no device's own: nothing else is compiled anew for it.
    assert not stored(powers)(Settings(3.0), X)["a"].committed


def test_other_content_shapes_types_and_settings_are_other_programs(folder, monkeypatch):
    asked = [(Settings(3.0), X), (Settings(2.0), X), (Settings(3.0, "a"), X), (Settings(3), X)]
    asked += [(Settings(3.0), X.astype(np.float32))]
    for k, (settings, x) in enumerate(asked):
        made = stored(powers)(settings, x)
        assert alike(made, eqx.filter_jit(powers)(settings, x))
        assert kept(folder) == k + 1
    monkeypatch.setenv("XLA_FLAGS", "--xla_of_another_kind")
    stored(powers)(Settings(3.0), X)
    assert kept(folder) == len(asked) + 1


def test_a_damaged_file_is_traced_anew(folder):
    plain = stored(powers)(Settings(3.0), X)
    [path] = folder.iterdir()
    whole = path.read_bytes()
    for damaged in (b"", b"{}\n", whole[:-10], whole.replace(b"sha256", b"sha255"), whole + b"x"):
        path.write_bytes(damaged)
        traced.clear()
        assert alike(stored(powers)(Settings(3.0), X), plain)
        assert traced
        traced.clear()
        stored(powers)(Settings(3.0), X)
        assert not traced


def test_where_nothing_can_be_kept_it_runs_as_ever(folder, tmp_path):
    # A function of nobody's package may hang on anything.
    settings = Settings(3.0, lambda: X)
    assert alike(stored(powers)(settings, X), eqx.filter_jit(powers)(settings, X))
    # Of a program within another the outer one is traced.
    slope = jax.grad(lambda x: jnp.sum(stored(powers)(Settings(3.0), x)["a"]))(jnp.asarray(X))
    np.testing.assert_allclose(slope, 3.0 * X**2, rtol=1e-14)
    assert kept(folder) == 0
    # A container that no file can name: its class is within a function.
    Local = NamedTuple("Local", [("y", Any)])  # noqa: UP014
    assert float(stored(lambda x: Local(x[0]))(X).y) == 1.0
    assert kept(folder) == 0
    taken = tmp_path / "file"
    taken.write_text("")
    keep_in(taken)
    assert alike(stored(powers)(Settings(3.0), X), eqx.filter_jit(powers)(Settings(3.0), X))


def test_errors_are_the_functions_own(folder):
    def refuses(x):
        raise ValueError("expected another x")

    with pytest.raises(ValueError, match="expected another x"):
        stored(refuses)(X)
    assert kept(folder) == 0


def test_models_are_told_apart_by_content():
    bench = models.roll_on_stand
    same = [content((with_disturbance(bench, "roll"), X)) for _ in range(2)]
    assert same[0] == same[1]
    others = [bench, with_disturbance(bench, "roll", 2), models.helicopter, None]
    assert len({same[0], *(content((m, X)) for m in others)}) == 5
    # Arrays are arguments there, and content in what a function closes over.
    assert content((X,)) == content((2.0 * X,))
    assert content((functools.partial(np.multiply, X),)) != content(
        (functools.partial(np.multiply, 2.0 * X),)
    )


def test_a_model_of_ones_own_is_not_told():
    mine = dataclasses.replace(models.roll_on_stand, output=lambda p, x, u: x)
    with pytest.raises(Unknown):
        content((mine,))

    class Params(NamedTuple):
        a: float

        @property
        def twice(self):
            return 2.0 * self.a

    with pytest.raises(Unknown):
        content((Params,))
    with pytest.raises(Unknown):
        content((Settings(1.0, object()),))
