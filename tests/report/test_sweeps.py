"""Figures of a sweep: medians of the data; elements that failed are shown but not counted."""

import sys

import matplotlib
import matplotlib.image
import numpy as np
import pytest
import xarray as xr

from heli_jax.report import sweeps

UNITS = {"Ixx": "kg*m^2", "If": "kg*m^2", "initial.phi": "rad", "misfit": "rad", "fit": "%"}


def dataset(axes, results, status=None):
    """Return a sweep by hand."""

    def variable(name, values):
        attributes = {"units": UNITS[name]} if name in UNITS else {}
        return (("element", "flight")[: np.ndim(values)], np.asarray(values), attributes)

    n = len(next(iter(axes.values())))
    status = np.zeros(n) if status is None else status
    coordinates = {k: variable(k, v) for k, v in axes.items()}
    return xr.Dataset(
        {k: v if isinstance(v, xr.DataArray) else variable(k, v) for k, v in results.items()},
        coords={**coordinates, "status": ("element", np.asarray(status, np.uint8))},
        attrs={"axes": list(axes)},
    )


def sweep(n=1000, seed=0):
    """Return three axes, one logarithmic and one with six values; some elements failed."""
    rng = np.random.default_rng(seed)
    axes = {
        "Ixx": np.exp(rng.uniform(np.log(0.01), 0.0, n)),
        "initial.phi": rng.normal(0.0, 0.1, n),
        "seed": rng.integers(1, 7, n),
    }
    misfit = np.abs(np.log(axes["Ixx"] / 0.1)) + 0.2 * axes["seed"] + 0.1 * rng.random(n)
    status = np.where(rng.random(n) < 0.1, rng.choice([1, 2, 255], n), 0)
    misfit[rng.random(n) < 0.03] = np.nan
    misfit[rng.random(n) < 0.02] = np.inf
    misfit[status == 2] = 1e6
    return dataset(axes, {"misfit": misfit}, status)


def slices(ds, result="misfit"):
    return sweeps.slices(sweeps.Table(ds), result)


def maps(ds, result="misfit"):
    return sweeps.maps(sweeps.Table(ds), result)


def counted(ds, *names):
    """Return the values that should count."""
    columns = [ds[n].to_numpy().astype(float) for n in names]
    use = (ds["status"].to_numpy() == 0) & np.all([np.isfinite(c) for c in columns], axis=0)
    return [c[use] for c in columns]


def title(figure):
    return figure.get_suptitle().replace("\n", " ")


def drawn(ax, name):
    [line] = [c for c in ax.get_lines() if c.get_label() == name]
    return np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)


def marked(ax):
    lines = [c for c in ax.get_lines() if c.get_label() == "_not ok"]
    return np.concatenate([np.asarray(c.get_xdata(), float) for c in lines] or [np.zeros(0)])


def meshes(figure):
    """Return (panel, edges of x, edges of y, values (x, y)) of each panel with a map."""
    found = []
    for ax in figure.axes:
        for mesh in ax.collections:
            if hasattr(mesh, "get_coordinates") and not hasattr(ax, "_colorbar"):
                grid = np.asarray(mesh.get_coordinates())
                values = np.ma.filled(np.ma.masked_invalid(mesh.get_array()), np.nan).T
                found.append((ax, grid[0, :, 0], grid[:, 0, 1], values))
    return found


def test_medians_and_band_are_those_of_bins_of_equal_count():
    ds = sweep()
    for ax, name in zip(slices(ds).axes, ["Ixx", "initial.phi"], strict=False):
        x, y = counted(ds, name, "misfit")
        order = np.argsort(x)
        edges = np.linspace(0, x.size, 21).astype(int)[1:-1]
        parts = np.split(y[order], edges)
        along, median = drawn(ax, "median")
        assert median == pytest.approx([np.median(p) for p in parts])
        assert along == pytest.approx([np.median(p) for p in np.split(x[order], edges)])
        [band] = ax.collections
        corners = band.get_paths()[0].vertices
        for k, part in enumerate(parts):
            here = corners[np.isclose(corners[:, 0], along[k]), 1]
            assert here.min() == pytest.approx(np.quantile(part, 0.05))
            assert here.max() == pytest.approx(np.quantile(part, 0.95))


def test_few_values_of_an_axis_are_bins_and_equal_values_stay_in_one():
    ds = sweep()
    ax = slices(ds).axes[2]
    x, y = counted(ds, "seed", "misfit")
    along, median = drawn(ax, "median")
    assert along.tolist() == [1, 2, 3, 4, 5, 6]
    assert median == pytest.approx([np.median(y[x == k]) for k in along])
    x = np.repeat(np.arange(300.0), 3)
    y = np.random.default_rng(1).random(900)
    along, median = drawn(slices(dataset({"x": x}, {"misfit": y})).axes[0], "median")
    assert along[0] == np.median(x[:45])
    assert median[0] == pytest.approx(np.median(y[:45]))


@pytest.mark.parametrize(("n", "cells"), [(40, (4, 4)), (30_000, (24, 24))])
def test_maps_are_medians_of_cells(n, cells):
    ds = sweep(n)
    ds["misfit"][: n // 2] = np.nan  # counts differ between cells
    found = meshes(maps(ds))
    pairs = [("Ixx", "initial.phi"), ("Ixx", "seed"), ("initial.phi", "seed")]
    assert found[0][3].shape == cells
    assert found[1][3].shape[1] == 6
    for (ax, ex, ey, values), (a, b) in zip(found, pairs, strict=True):
        x, y, z = counted(ds, a, b, "misfit")
        assert (ax.get_xlabel().split()[0], ax.get_ylabel().split()[0]) == (a, b)
        which = [
            np.clip(np.searchsorted(e, v, "right") - 1, 0, e.size - 2)
            for e, v in ((ex, x), (ey, y))
        ]
        for i, j in np.ndindex(values.shape):
            here = z[(which[0] == i) & (which[1] == j)]
            expected = np.median(here) if here.size else np.nan
            assert values[i, j] == pytest.approx(expected, nan_ok=True)


def test_elements_that_are_not_ok_change_nothing_but_their_marks():
    ds = sweep()
    bad = ds["status"].to_numpy() != 0
    other = ds.copy(deep=True)
    other["misfit"][bad] = -1e9
    for draw in (slices, maps):
        a, b = draw(ds), draw(other)
        for one, two in zip(a.axes, b.axes, strict=True):
            assert one.get_ylim() == two.get_ylim()
            for p, q in zip(one.get_lines(), two.get_lines(), strict=True):
                assert np.array_equal(p.get_ydata(), q.get_ydata())
    for p, q in zip(meshes(a), meshes(b), strict=True):
        assert np.array_equal(p[3], q[3], equal_nan=True)
    assert marked(a.axes[0]).size == bad.sum()
    assert sorted(marked(slices(ds).axes[0])) == sorted(ds["Ixx"].to_numpy()[bad])
    assert title(a).startswith(f"misfit: {1000 - bad.sum()} of 1000 elements ok")


def test_an_axis_that_is_not_finite_is_left_out():
    ds = sweep()
    ixx, status = ds["Ixx"].to_numpy().copy(), ds["status"].to_numpy().copy()
    ixx[:31] = [*np.full(30, np.nan), np.inf]
    status[:31] = 1
    ds = dataset({"Ixx": ixx, "seed": ds["seed"].to_numpy()}, {"misfit": ds["misfit"]}, status)
    assert np.isfinite(marked(slices(ds).axes[0])).all()
    assert maps(ds) is not None
    none = dataset({"Ixx": np.full(5, np.nan)}, {"misfit": np.ones(5)})
    assert slices(none) is maps(none) is None


@pytest.mark.parametrize(
    ("low", "high", "scale"),
    [(1.0, 31.0, "log"), (1.0, 29.0, "linear"), (-1.0, 99.0, "linear")],
)
def test_wide_axes_of_one_sign_are_logarithmic(low, high, scale):
    x = np.linspace(low, high, 200)
    figure = maps(dataset({"x": x, "Ixx": x[::-1]}, {"misfit": x**2}))
    ax = figure.axes[0]
    assert (ax.get_xscale(), ax.get_yscale()) == (scale, scale)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x", "Ixx [kg m²]")
    assert figure.axes[-1].get_ylabel() == "misfit [rad]"
    assert ax.get_xlim() == pytest.approx((low, high))
    assert len(ax.get_xticks()) > 2
    _, ex, _, _ = meshes(figure)[0]
    steps = np.diff(ex if scale == "linear" else np.log(np.abs(ex)))
    assert steps == pytest.approx(np.full(steps.size, steps[0]))


def test_single_elements_do_not_press_the_others_flat():
    rng = np.random.default_rng(2)
    y = rng.standard_normal(2000)
    y[:5] = 1e9
    figure = slices(dataset({"x": rng.random(2000)}, {"misfit": y}))
    assert figure.axes[0].get_ylim()[1] < 10.0
    assert "5 beyond the panel" in title(figure)


def test_one_axis():
    t = np.repeat(np.linspace(0.1, 1.0, 15), 2)
    ds = dataset({"T": t}, {"misfit": 1.0 / t})
    assert maps(ds) is None
    along, median = drawn(slices(ds).axes[0], "median")
    assert along == pytest.approx(t[::2])
    assert median == pytest.approx(1.0 / t[::2])


def test_results_of_several_flights_are_means():
    rng = np.random.default_rng(3)
    both = rng.random((300, 2))
    both[:5] = [*[[np.nan, 1.0]] * 4, [np.inf, -np.inf]]
    ds = dataset({"Ixx": rng.random(300), "seed": rng.integers(0, 3, 300)}, {"fit": both})
    figure = slices(ds, "fit")
    _, median = drawn(figure.axes[1], "median")
    mean, seed = both[5:].mean(axis=1), ds["seed"].to_numpy()[5:]
    assert median == pytest.approx([np.median(mean[seed == k]) for k in range(3)])
    assert "mean over 2 flights" in title(figure)
    assert drawn(slices(ds.transpose(), "fit").axes[1], "median")[1] == pytest.approx(median)


def test_a_large_sweep_is_drawn_by_lot(monkeypatch):
    ds = sweep(4000)
    monkeypatch.setattr(sweeps, "DRAWN", 400)
    table = sweeps.Table(ds)
    assert (table.size, table.n_ok) == (4000, np.count_nonzero(ds["status"] == 0))
    assert np.count_nonzero(table.ok) == 400
    assert np.count_nonzero(~table.ok) == 200
    some = ds.isel(element=table.elements)
    for name in ("Ixx", "misfit"):
        column, values = table.column(name), some[name].to_numpy()
        np.testing.assert_array_equal(column.values[column.finite], values[np.isfinite(values)])
    assert f"{table.elements.size} drawn, by lot" in title(sweeps.slices(table, "misfit"))


def test_files(tmp_path):
    """Test names impossible for files, numbers impossible in pictures, and missing results."""
    ds = sweep(3000).rename({"misfit": "a/b"})
    ds["a/b"][:3] = [1e300, -1e300, 5e-324]
    ds["A.B"] = -1.0 / ds["Ixx"]
    ds["modes_real"] = (("element", "mode"), np.ones((3000, 2)))
    ds["trajectory_last"] = ("element", np.ones(3000))
    before = dict(matplotlib.rcParams)
    where = tmp_path / "new" / "figures"
    files = sweeps.write_figures(where, ds)
    names = ["slices-a_b", "maps-a_b", "slices-A_B-2", "maps-A_B-2"]
    assert [p.name for p in files] == [f"{n}.{e}" for n in names for e in ("png", "svg")]
    assert sorted(files) == sorted(where.iterdir())
    for path in files:
        if path.suffix == ".png":
            assert matplotlib.image.imread(path)[..., :3].std() > 0.02
        else:
            assert path.stat().st_size < 500_000
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or pyplot.get_fignums() == []


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_elements(n):
    ds = dataset({"Ixx": np.linspace(0.1, 0.3, n), "seed": np.arange(n)}, {"misfit": [0.3] * n})
    assert [figure is None for figure in (slices(ds), maps(ds))] == [n == 0] * 2


@pytest.mark.parametrize("lost", [True, False])
def test_nothing_to_count_is_no_error(lost):
    ds = sweep(40)
    ds["misfit"][:] = 1.0 if lost else np.nan
    ds["status"][:] = 1 if lost else 0
    assert marked(slices(ds).axes[0]).size == (40 if lost else 0)
    assert maps(ds) is not None


def test_a_fine_grid_is_mapped_at_its_own_resolution():
    x, y = np.meshgrid(np.linspace(1.0, 2.0, 60), np.linspace(3.0, 5.0, 50), indexing="ij")
    z = np.sin(9.0 * x) * y
    ds = dataset({"Ixx": x.ravel(), "a": y.ravel()}, {"misfit": z.ravel()})
    [(_, _, _, values)] = meshes(maps(ds))
    np.testing.assert_array_equal(values, z)
