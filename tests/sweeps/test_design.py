"""Designs: values of the axes, against NumPy, SciPy and itertools."""

import itertools

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.stats.qmc
from hypothesis import given

from heli_jax.sweeps import Range, grid, lhs, paired, product, sobol, table, zipped

AXES = {"Ixx": Range(0.01, 0.1, "log"), "a": Range(4.0, 6.0)}


def whole(design):
    return design.values(0, design.size)


DESIGNS = {
    "grid": grid({"Ixx": Range(0.01, 0.1, "log", 7), "a": [1.0, 2.0, 4.0], "If": [3.0]}),
    "list": paired({"Ixx": [1.0, 2.0, 3.0], "a": Range(0.0, 1.0, n=3)}),
    "lhs": lhs(AXES, 50, seed=3),
    "sobol": sobol(AXES, 50, seed=3),
    "table": table({"Ixx": np.array([1.0, np.nan, 3.0]), "a": np.arange(3.0)}),
    "product": product(sobol(AXES, 9), grid({"seed": np.arange(4), "If": [1.0, 2.0]})),
    "zip": zipped(sobol(AXES, 6), paired({"seed": np.arange(6)})),
    "nested": product(zipped(lhs(AXES, 5), paired({"seed": np.arange(5)})), grid({"B": [0.9, 1]})),
}


@pytest.mark.parametrize("name", DESIGNS)
@given(data=st.data())
def test_slices_are_parts_of_the_whole(name, data):
    design = DESIGNS[name]
    start = data.draw(st.integers(0, design.size))
    stop = data.draw(st.integers(start, design.size))
    everything, part = whole(design), design.values(start, stop)
    assert tuple(part) == design.names
    for axis in design.names:
        assert everything[axis].shape == (design.size,)
        np.testing.assert_array_equal(part[axis], everything[axis][start:stop])


def test_a_grid_is_every_combination_the_last_axis_fastest():
    axes = {"Ixx": [1.0, 2.0, 3.0], "If": [5.0, 7.0], "a": [0.5, 0.25, 0.125, 0.0]}
    found = whole(grid(axes))
    rows = list(zip(*(found[n] for n in axes), strict=True))
    assert rows == list(itertools.product(*axes.values()))


def test_points_of_an_axis_reach_both_ends_evenly():
    found = whole(grid({"a": Range(-1.0, 2.0, n=7)}))["a"]
    np.testing.assert_allclose(found, np.linspace(-1.0, 2.0, 7), rtol=1e-15, atol=1e-15)
    found = whole(grid({"a": Range(-1e3, -1e-3, "log", 7)}))["a"]
    np.testing.assert_allclose(found, -np.geomspace(1e3, 1e-3, 7), rtol=1e-13)
    assert found[0] == -1e3
    assert found[-1] == -1e-3


@pytest.mark.parametrize(("make", "engine"), [(sobol, "Sobol"), (lhs, "LatinHypercube")])
def test_samples_are_scipys(make, engine):
    found = whole(make(AXES, 64, seed=11))
    rng = np.random.default_rng(11)
    points = getattr(scipy.stats.qmc, engine)(2, rng=rng).random(64)
    np.testing.assert_allclose(found["a"], 4.0 + 2.0 * points[:, 1], rtol=1e-14)
    np.testing.assert_allclose(found["Ixx"], 0.01 * 10.0 ** points[:, 0], rtol=1e-13)
    assert not np.array_equal(found["a"], whole(make(AXES, 64, seed=12))["a"])


def test_a_latin_hypercube_has_one_point_in_every_row():
    found = whole(lhs({"a": Range(0.0, 1.0), "Ixx": Range(0.0, 1.0)}, 40, seed=1))
    for v in found.values():
        np.testing.assert_array_equal(np.sort(np.floor(40 * v)), np.arange(40))


def test_seeds_stay_whole_numbers():
    assert whole(DESIGNS["product"])["seed"].dtype.kind == "i"


def test_descriptions_tell_designs_apart():
    texts = [str(d.description) for d in DESIGNS.values()]
    assert len(set(texts)) == len(texts)
    assert sobol(AXES, 50, seed=3).description == DESIGNS["sobol"].description
    assert sobol(AXES, 50, seed=4).description != DESIGNS["sobol"].description
    other = table({"Ixx": np.array([1.0, np.nan, 3.5]), "a": np.arange(3.0)})
    assert other.description != DESIGNS["table"].description


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: grid({}), "none given"),
        (lambda: paired({}), "none given"),
        (lambda: sobol({}, 3), "none given"),
        (lambda: grid({"a": []}), "axes.a: no values"),
        (lambda: table({"a": np.array([])}), "axes.a: no values"),
        (lambda: grid({"a": ["x"]}), "expected numbers"),
        (lambda: grid({"a": Range(1.0, 2.0)}), "at least 2 points"),
        (lambda: grid({"a": Range(1.0, 2.0, n=1)}), "at least 2 points"),
        (lambda: grid({"a": Range(2.0, 1.0, n=3)}), "lower < upper"),
        (lambda: lhs({"a": Range(1.0, 1.0)}, 3), "lower < upper"),
        (lambda: lhs({"a": Range(-1.0, 1.0, "log")}, 3), "one sign"),
        (lambda: lhs({"a": Range(1.0, np.inf)}, 3), "lower < upper"),
        (lambda: lhs({"a": Range(1.0, 2.0, "cubic")}, 3), "linear or log"),
        (lambda: lhs({"a": [1.0, 2.0]}, 3), "lower and upper"),
        (lambda: sobol(AXES, 0), "n must be at least 1, got 0"),
        (lambda: paired({"a": [1.0, 2.0], "Ixx": [1.0]}), "a has 2, Ixx has 1"),
        (lambda: table({"a": np.ones(2), "Ixx": np.ones(3)}), "Ixx has 3"),
        (lambda: zipped(lhs(AXES, 3), paired({"B": [1.0, 2.0]})), "3 and 2 elements"),
        (lambda: zipped(lhs(AXES, 3), lhs(AXES, 3)), "'Ixx' is in two designs"),
        (lambda: product(), "no designs"),
        (lambda: product(lhs(AXES, 3), paired({"a": [1.0]})), "'a' is in two designs"),
    ],
)
def test_what_cannot_be_a_design_is_refused_in_words(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_an_axis_with_a_logarithmic_scale_is_drawn_so():
    log = Range(0.01, 0.1, "log", 7)
    axes = {"Ixx": log, "If": Range(1.0, 2.0, n=5), "a": [1.0, 10.0, 100.0], "c": [4.0, 5.0]}
    assert grid(axes).logarithmic == {"Ixx"}
    assert product(grid({"Ixx": log}), sobol({"a": Range(1.0, 9.0, "log")}, 4)).logarithmic == {
        "Ixx",
        "a",
    }
