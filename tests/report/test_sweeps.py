"""Figures of a sweep: medians are those of the data, what is not ok does not count but shows."""

import sys

import matplotlib
import matplotlib.image
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex

from heli_jax.numbers import number
from heli_jax.report import style, sweeps
from heli_jax.report.sweeps import columns
from heli_jax.sweeps import chunks as pieces

UNITS = {"Ixx": "kg*m^2", "If": "kg*m^2", "initial.phi": "rad", "misfit": "rad", "fit": "%"}


def dataset(axes, results, status=None):
    """A sweep by hand."""

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
    """Three axes, one of them logarithmic and one with six values; some elements not ok."""
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


def counted(ds, *names):
    """The values that should count."""
    columns = [ds[n].to_numpy().astype(float) for n in names]
    use = (ds["status"].to_numpy() == 0) & np.all([np.isfinite(c) for c in columns], axis=0)
    return [c[use] for c in columns]


def titles(figure):
    return figure.axes[0].get_title("left") + " " + " ".join(t.get_text() for t in words(figure))


def words(figure):
    return [t for ax in figure.axes for t in ax.texts]


def drawn(ax, name):
    [line] = [c for c in ax.get_lines() if c.get_label() == name]
    return np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)


def marked(ax):
    lines = [c for c in ax.get_lines() if c.get_label() == "_not ok"]
    return np.concatenate([np.asarray(c.get_xdata(), float) for c in lines] or [np.zeros(0)])


def meshes(figure):
    """(panel, edges of x, edges of y, values (x, y)) of each panel with a map."""
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
    for ax, name in zip(sweeps.slices(ds, "misfit").axes, ["Ixx", "initial.phi"], strict=False):
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


def test_few_values_of_an_axis_are_bins():
    ds = sweep()
    ax = sweeps.slices(ds, "misfit").axes[2]
    x, y = counted(ds, "seed", "misfit")
    along, median = drawn(ax, "median")
    assert along.tolist() == [1, 2, 3, 4, 5, 6]
    assert median == pytest.approx([np.median(y[x == k]) for k in along])
    segments = np.array(ax.collections[0].get_segments())
    assert segments[:, 0, 1] == pytest.approx([np.quantile(y[x == k], 0.05) for k in along])
    alone = dataset({"seed": x.astype(int)}, {"misfit": y})
    ax = sweeps.slices(alone, "misfit").axes[0]
    assert [t.get_text() for t in ax.get_xticklabels()] == ["1", "2", "3", "4", "5", "6"]


def test_equal_values_of_an_axis_stay_in_one_bin():
    x = np.repeat(np.arange(30.0), 30)
    y = np.random.default_rng(1).random(900)
    along, median = drawn(
        sweeps.slices(dataset({"x": x}, {"misfit": y}), "misfit").axes[0], "median"
    )
    assert along[:4].tolist() == [0.0, 1.5, 3.0, 4.5]
    assert median[:2] == pytest.approx([np.median(y[:30]), np.median(y[30:90])])


@pytest.mark.parametrize("n", [40, 1000, 30_000])
def test_maps_are_medians_of_cells(n):
    ds = sweep(n)
    ds["misfit"][: n // 2] = np.nan  # counts differ between cells
    found = meshes(sweeps.maps(ds, "misfit"))
    pairs = [("Ixx", "initial.phi"), ("Ixx", "seed"), ("initial.phi", "seed")]
    assert len(found) == 3
    for (ax, ex, ey, values), (a, b) in zip(found, pairs, strict=True):
        x, y, z = counted(ds, a, b, "misfit")
        assert (ax.get_xlabel().split()[0], ax.get_ylabel().split()[0]) == (a, b)
        which = [
            np.clip(np.searchsorted(e, v, "right") - 1, 0, e.size - 2)
            for e, v in ((ex, x), (ey, y))
        ]
        for i in range(ex.size - 1):
            for j in range(ey.size - 1):
                here = z[(which[0] == i) & (which[1] == j)]
                expected = np.median(here) if here.size else np.nan
                assert values[i, j] == pytest.approx(expected, nan_ok=True)
    assert found[1][3].shape[1] == 6
    assert found[0][3].shape == {40: (4, 4), 1000: (10, 10), 30_000: (24, 24)}[n]


def test_elements_that_are_not_ok_change_nothing_but_their_marks():
    ds = sweep()
    bad = ds["status"].to_numpy() != 0
    other = ds.copy(deep=True)
    other["misfit"][bad] = -1e9
    for draw in (sweeps.slices, sweeps.maps):
        a, b = draw(ds, "misfit"), draw(other, "misfit")
        for one, two in zip(a.axes, b.axes, strict=True):
            assert one.get_ylim() == two.get_ylim()
            for p, q in zip(one.get_lines(), two.get_lines(), strict=True):
                assert np.array_equal(p.get_ydata(), q.get_ydata())
    for p, q in zip(meshes(a), meshes(b), strict=True):
        assert np.array_equal(p[3], q[3], equal_nan=True)
    assert sorted(marked(sweeps.slices(ds, "misfit").axes[0])) == sorted(ds["Ixx"].to_numpy()[bad])
    assert marked(sweeps.maps(ds, "misfit").axes[0]).size == bad.sum()


def test_an_axis_that_is_not_finite_is_left_out():
    ds = sweep()
    ixx = ds["Ixx"].to_numpy().copy()
    ixx[:30] = np.nan
    ixx[30] = np.inf
    status = ds["status"].to_numpy().copy()
    status[:31] = 1
    ds = dataset({"Ixx": ixx, "seed": ds["seed"].to_numpy()}, {"misfit": ds["misfit"]}, status)
    assert np.isfinite(marked(sweeps.slices(ds, "misfit").axes[0])).all()
    assert sweeps.maps(ds, "misfit") is not None
    assert sweeps.corner(ds) is not None
    assert sweeps.worst(ds, {"misfit": np.array([40])}) is not None
    none = dataset({"Ixx": np.full(5, np.nan)}, {"misfit": np.ones(5)})
    assert sweeps.slices(none, "misfit") is None
    assert sweeps.corner(none) is None


def test_titles_count_elements():
    ds = sweep()
    ok = int((ds["status"] == 0).sum())
    said = f"{ok} of 1000 elements ok"
    assert said in titles(sweeps.slices(ds, "misfit"))
    assert said in titles(sweeps.maps(ds, "misfit"))
    assert said in titles(sweeps.corner(ds))
    assert said in titles(sweeps.worst(ds, {"misfit": np.array([1])}))
    [finite] = counted(ds, "misfit")
    assert f"{ok - finite.size} not finite" in titles(sweeps.slices(ds, "misfit"))
    long = ds.rename({"misfit": "m" * 200})
    assert said in sweeps.slices(long, "m" * 200).axes[0].get_title("left")


def test_labels_carry_units():
    ds = sweep()
    first, second, third = sweeps.slices(ds, "misfit").axes
    assert (first.get_xlabel(), first.get_ylabel()) == ("Ixx [kg m²]", "misfit [rad]")
    assert second.get_xlabel() == "initial.phi [rad]"
    assert third.get_xlabel() == "seed"
    *panels, bar = sweeps.maps(ds, "misfit").axes
    assert (panels[0].get_xlabel(), panels[0].get_ylabel()) == ("Ixx [kg m²]", "initial.phi [rad]")
    assert bar.get_ylabel() == "misfit [rad]"
    names = [t.get_text() for t in sweeps.worst(ds, {"misfit": [1]}).axes[0].get_xticklabels()]
    assert names == ["Ixx\n[kg m²]", "initial.phi\n[rad]", "seed"]
    labels = {ax.get_xlabel().replace("\n", " ") for ax in sweeps.corner(ds).axes}
    assert {"Ixx [kg m²]", "initial.phi [rad]", "seed", "misfit [rad]"} <= labels


def test_small_numbers_and_small_differences_are_readable():
    small = np.linspace(2e-5, 8e-5, 60)
    ds = dataset({"If": small}, {"misfit": 1000.0 + 1e-6 * np.sin(1e5 * small)})
    figure = sweeps.slices(ds, "misfit")
    figure.draw_without_rendering()
    [ax] = figure.axes
    assert ax.get_xlabel() == "If [10⁻⁵ kg m²]"
    assert ax.get_ylabel() == "misfit − 1000 [10⁻⁶ rad]"
    assert {"2", "4", "6", "8"} <= {t.get_text() for t in ax.get_xticklabels()}
    assert {"−1", "0", "1"} <= {t.get_text() for t in ax.get_yticklabels()}


@pytest.mark.parametrize(
    ("low", "high", "scale"),
    [(1.0, 31.0, "log"), (1.0, 29.0, "linear"), (-100.0, -1.0, "symlog"), (-1.0, 99.0, "linear")],
)
def test_wide_axes_of_one_sign_are_logarithmic(low, high, scale):
    x = np.linspace(low, high, 200)
    ds = dataset({"x": x, "Ixx": x[::-1]}, {"misfit": x**2})
    ax = sweeps.slices(ds, "misfit").axes[0]
    assert ax.get_xscale() == scale
    left, right = ax.get_xlim()
    assert left < low < high < right
    assert len(ax.get_xticks()) > 2
    assert sweeps.maps(ds, "misfit").axes[0].get_yscale() == scale
    _, ex, _, _ = meshes(sweeps.maps(ds, "misfit"))[0]
    steps = np.diff(ex if scale == "linear" else np.log(np.abs(ex)))
    assert steps == pytest.approx(np.full(steps.size, steps[0]))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("low", "high"), [(2.1e-5, 4.9e-5), (0.021, 0.049), (1.0, 1e9)])
def test_logarithmic_axes_have_different_labels_however_narrow(low, high, sign):
    ds = dataset({"x": sign * np.geomspace(low, high, 50)}, {"misfit": np.linspace(0.0, 1.0, 50)})
    ds["x"].attrs["scale"] = "log"
    figure = sweeps.slices(ds, "misfit")
    figure.draw_without_rendering()
    [ax] = figure.axes
    assert ax.get_xscale() == ("log" if sign > 0 else "symlog")
    ticks, labels = ax.get_xticks(), [t.get_text() for t in ax.get_xticklabels()]
    assert 3 <= len(set(labels)) == len(ticks) <= 20
    left, right = ax.get_xlim()
    assert all(left <= v <= right for v in ticks)


def test_single_elements_do_not_press_the_others_flat():
    rng = np.random.default_rng(2)
    y = rng.standard_normal(2000)
    y[:5] = 1e9
    figure = sweeps.slices(dataset({"x": rng.random(2000)}, {"misfit": y}), "misfit")
    assert figure.axes[0].get_ylim()[1] < 10.0
    assert "5 beyond the panel" in titles(figure)


def test_many_elements_are_thinned_and_drawn_as_pixels():
    figure = sweeps.slices(sweep(20_000), "misfit")
    for ax in figure.axes:
        [dots] = [c for c in ax.get_lines() if c.get_label() == "_elements"]
        assert np.size(dots.get_xdata()) == 2000
        assert dots.get_rasterized()
        assert 0 < marked(ax).size <= 300
    assert "2000 by lot" in titles(figure)
    assert all(ax.collections[0].get_rasterized() for ax, *_ in meshes(figure))


def test_one_axis():
    t = np.linspace(0.1, 1.0, 15)
    ds = dataset({"T": t}, {"misfit": 1.0 / t})
    assert sweeps.maps(ds, "misfit") is None
    along, median = drawn(sweeps.slices(ds, "misfit").axes[0], "median")
    assert along == pytest.approx(t)
    assert median == pytest.approx(1.0 / t)
    assert len(sweeps.corner(ds).axes) == 3
    assert sweeps.worst(ds, {"misfit": np.array([0, 1])}) is not None


def test_results_of_several_flights_are_means():
    rng = np.random.default_rng(3)
    both = rng.random((300, 2))
    both[:4, 0] = np.nan
    both[4] = [np.inf, -np.inf]
    axes = {"Ixx": rng.random(300), "seed": rng.integers(0, 3, 300)}
    ds = dataset(axes, {"fit": both})
    figure = sweeps.slices(ds, "fit")
    _, median = drawn(figure.axes[1], "median")
    mean, seed = both[5:].mean(axis=1), axes["seed"][5:]
    assert median == pytest.approx([np.median(mean[seed == k]) for k in range(3)])
    assert "mean over 2 flights" in titles(figure)
    assert "mean over 2 flights" in titles(sweeps.maps(ds, "fit"))
    assert "means over 2 flights" in titles(sweeps.corner(ds))
    assert "means over 2 flights" in titles(sweeps.worst(ds, {"fit": np.array([7])}))
    assert drawn(sweeps.slices(ds.transpose(), "fit").axes[1], "median")[1] == pytest.approx(median)


def test_what_has_no_number_for_each_element_is_skipped(tmp_path):
    ds = sweep(30)
    ds["modes_real"] = (("element", "mode"), np.ones((30, 2)))
    ds["trajectory_roll"] = (("element", "time"), np.ones((30, 4)))
    ds["trajectory_last"] = ("element", np.ones(30))
    assert sweeps.slices(ds, "modes_real") is None
    assert sweeps.maps(ds, "trajectory_roll") is None
    assert sweeps.slices(ds, "trajectory_last") is None
    assert sweeps.slices(ds, "nothing") is None
    files = sweeps.write_figures(tmp_path, ds, {"modes_real": np.array([1])})
    stems = ["slices-misfit", "maps-misfit", "corner"]
    assert [p.name for p in files] == [f"{s}.{e}" for s in stems for e in ("png", "svg")]


@pytest.mark.parametrize("why", ["no element is ok", "no finite value"])
def test_nothing_to_count_is_said(why, tmp_path):
    lost = why == "no element is ok"
    ds = sweep(40)
    ds["misfit"][:] = 1.0 if lost else np.nan
    ds["status"][:] = 1 if lost else 0
    for figure in (sweeps.slices(ds, "misfit"), sweeps.maps(ds, "misfit")):
        assert why in titles(figure)
        assert f"{0 if lost else 40} of 40 elements ok" in titles(figure)
        assert marked(figure.axes[0]).size == (40 if lost else 0)
    assert sweeps.corner(ds) is not None
    assert sweeps.worst(ds, {"misfit": np.zeros(0, int)}) is None
    assert sweeps.worst(ds, {}) is None
    files = sweeps.write_figures(tmp_path, ds, {})
    assert {p.stem for p in files} == {"slices-misfit", "maps-misfit", "corner"}


def test_no_elements_are_no_figures(tmp_path):
    ds = sweep(5).isel(element=slice(0, 0))
    assert sweeps.write_figures(tmp_path, ds, {}) == []


@pytest.mark.parametrize("n", [1, 2, 9])
def test_few_elements(n, tmp_path):
    rng = np.random.default_rng(n)
    axes = {"Ixx": rng.random(n), "seed": np.arange(n)}
    ds = dataset(axes, {"misfit": rng.random(n), "same": np.full(n, 0.3)})
    files = sweeps.write_figures(tmp_path, ds, {"misfit": np.array([0]), "same": np.array([0])})
    assert len(files) == 12


def test_corner_counts_what_is_ok():
    ds = sweep()
    figure = sweeps.corner(ds)
    assert len(figure.axes) == 10
    for k, name in [(0, "Ixx"), (2, "initial.phi"), (5, "seed"), (9, "misfit")]:
        [stairs] = figure.axes[k].patches
        values, edges, _ = stairs.get_data()
        [use] = counted(ds, name)
        assert values.sum() == use.size
        assert values[0] == np.count_nonzero(use < edges[1])
    bad = int((ds["status"] != 0).sum())
    assert [marked(ax).size for ax in figure.axes] == [0, bad, 0, bad, bad, 0, 0, 0, 0, 0]


def test_corner_has_seven_variables_and_both_kinds():
    rng = np.random.default_rng(4)
    axes = {f"a{k}": rng.random(3000) for k in range(9)}
    ds = dataset(axes, {f"r{k}": rng.random(3000) for k in range(5)})
    figure = sweeps.corner(ds)
    bottom = [ax.get_xlabel() for ax in figure.axes[-7:]]
    assert bottom == ["a0", "a1", "a2", "a3", "r0", "r1", "r2"]
    assert "the first 7 of 14 variables" in titles(figure)
    assert len(meshes(figure)) == 21
    total = [np.nansum(m[3]) for m in meshes(figure)]
    assert total == pytest.approx([3000] * 21)
    assert len(sweeps.slices(ds, "r0").axes) == 8
    assert len(meshes(sweeps.maps(ds, "r0"))) == 6


def test_worst_elements_are_named_and_lie_where_they_are():
    ds = sweep()
    ds["fit"] = ds["misfit"] * 0 + 50.0
    ds["misfit"][17] = 1.25
    figure = sweeps.worst(ds, {"misfit": np.array([17, 4]), "fit": np.array([3])})
    [ax] = figure.axes
    [legend] = figure.legends
    texts = [t.get_text() for t in legend.get_texts()]
    assert texts[0] == "misfit: element 17, 1.25 rad"
    assert [t.split(",")[0] for t in texts[1:]] == ["misfit: element 4", "fit: element 3"]
    lines = [c for c in ax.get_lines() if "element" in str(c.get_label())]
    ixx, phi, seed = (ds[n].to_numpy().astype(float) for n in ds.attrs["axes"])
    x, y = np.asarray(lines[0].get_xdata()), np.asarray(lines[0].get_ydata())
    low, high = np.log(ixx.min()), np.log(ixx.max())
    assert x.tolist() == [0, 1, 2]
    assert y[0] == pytest.approx((np.log(ixx[17]) - low) / (high - low))
    assert y[1] == pytest.approx((phi[17] - phi.min()) / np.ptp(phi))
    assert y[2] == pytest.approx((seed[17] - 1.0) / 5.0)
    colours = [to_hex(c.get_color()) for c in lines]
    assert colours[0] == colours[1] != colours[2]
    [bundle] = [c for c in ax.collections if len(c.get_paths()) == 300]
    assert bundle.get_zorder() < lines[0].get_zorder()


def test_what_is_no_number_of_an_element_is_no_result_drawn():
    ds = sweep(20)
    ds["m_real"] = ("element", "mode"), np.zeros((20, 4))
    ds["trajectory_roll"] = ("element", "time"), np.zeros((20, 5))
    assert sweeps.results(ds) == ["misfit"]


def test_a_large_sweep_is_drawn_by_lot(monkeypatch):
    ds = sweep(4000)
    ds["rare"] = ds["misfit"] * np.nan
    monkeypatch.setattr(columns, "DRAWN", 400)
    monkeypatch.setattr(pieces, "_ELEMENTS", 300)
    ok = int(np.count_nonzero(ds["status"] == 0))
    table = columns.Table(ds, [np.array([17, 3999])])
    assert (table.size, table.n_ok) == (4000, ok)
    assert {17, 3999} <= set(table.elements.tolist())
    assert 400 <= np.count_nonzero(table.ok) <= 402
    assert 200 <= np.count_nonzero(~table.ok) <= 202
    some = ds.isel(element=table.elements)
    for name in ("Ixx", "misfit"):
        column, values = table.column(name), some[name].to_numpy()
        np.testing.assert_array_equal(column.values[column.finite], values[np.isfinite(values)])
    median = np.median(counted(ds, "misfit")[0])
    assert np.median(table.column("misfit").values[table.column("misfit").used]) == pytest.approx(
        median, rel=0.1
    )
    at = table.at(np.array([17, 3999]))
    np.testing.assert_array_equal(table.column("Ixx").values[at], ds["Ixx"][[17, 3999]])

    worst = {"misfit": np.array([17, 3999])}
    n = f"{len(columns.Table(ds).elements)} drawn, by lot"
    for figure in (sweeps.slices(ds, "misfit"), sweeps.maps(ds, "misfit"), sweeps.corner(ds)):
        assert f"{ok} of 4000 elements ok" in titles(figure)
        assert n in titles(figure)
    assert "no finite value drawn: rare" in titles(sweeps.corner(ds))
    figure = sweeps.worst(ds, worst)
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert [t.split(",")[0] for t in labels] == ["misfit: element 17", "misfit: element 3999"]
    assert labels[0].split(", ")[1] == f"{number(float(ds['misfit'][17]))} rad"
    assert "by lot" in titles(figure)
    # Nothing of this where all are drawn.
    monkeypatch.setattr(columns, "DRAWN", 4000)
    assert "drawn" not in titles(sweeps.corner(ds))


def test_files(tmp_path):
    ds = sweep(3000).rename({"misfit": "a/b"})
    ds["initial.phi_rms"] = 1.0 / ds["Ixx"]
    ds["A.B"] = -1.0 / ds["Ixx"]
    before = dict(matplotlib.rcParams)
    where = tmp_path / "new" / "figures"
    files = sweeps.write_figures(where, ds, {"a/b": np.arange(5), "A.B": np.array([7])})
    names = ["slices-a_b", "maps-a_b", "slices-initial_phi_rms", "maps-initial_phi_rms"]
    names += ["slices-A_B-2", "maps-A_B-2", "corner", "worst"]
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


def test_results_that_no_picture_can_hold(tmp_path):
    rng = np.random.default_rng(5)
    values = rng.random(500)
    values[:3] = [1e300, -1e300, 5e-324]
    axes = {"Ixx": rng.random(500), "If": 1e-300 * rng.random(500)}
    ds = dataset(axes, {"misfit": values, "zero": np.zeros(500)})
    assert len(sweeps.write_figures(tmp_path, ds, {"misfit": np.array([0, 2])})) == 12


@pytest.mark.parametrize("many", [False, True])
def test_no_labels_lie_on_each_other(many):
    rng = np.random.default_rng(6)
    n = 2000
    axes = {"Ixx": rng.uniform(1e-3, 1.0, n), "a_name_that_is_rather_long": rng.random(n) * 1e-5}
    if many:
        axes |= {f"x{k}": 10.0**k * rng.standard_normal(n) for k in range(6)}
    results = {
        "yaw_rate_rmse_of_all": np.exp(rng.normal(0, 3, n)),
        "level": 1000 + axes["Ixx"] / 1e4,
    }
    ds = dataset(axes, results)
    with matplotlib.rc_context(style.STYLE):
        found = {k: np.arange(5) for k in results}
        figures = [sweeps.corner(ds), sweeps.worst(ds, found)]
        figures += [draw(ds, r) for r in results for draw in (sweeps.slices, sweeps.maps)]
        for figure in figures:
            figure.draw_without_rendering()
            boxes = [(text, b.padded(-1.0)) for text, b in label_boxes(figure)]
            (left, bottom), (right, top) = figure.bbox.get_points()
            for k, (text, one) in enumerate(boxes):
                assert left <= one.x0 < one.x1 <= right, text
                assert bottom <= one.y0 < one.y1 <= top, text
                assert not [(text, t) for t, other in boxes[k + 1 :] if one.overlaps(other)]


def label_boxes(figure):
    """Where labels, titles and those tick labels are that are seen and do not lean."""
    for ax in figure.axes:
        panel = ax.get_window_extent()
        texts = [ax.xaxis.label, ax.yaxis.label, ax._left_title, *ax.texts]
        for k, axis in enumerate((ax.xaxis, ax.yaxis)):
            for t in axis.get_ticklabels():
                middle = np.mean(t.get_window_extent().get_points()[:, k])
                inside = panel.min[k] - 2 <= middle <= panel.max[k] + 2
                texts += [t] if inside and t.get_rotation() == 0 else []
        shown = [t for t in texts if t.get_visible() and t.get_text().strip()]
        yield from ((t.get_text(), t.get_window_extent()) for t in shown)


def test_a_fine_grid_is_mapped_at_its_own_resolution():
    x, y = np.meshgrid(np.linspace(1.0, 2.0, 60), np.linspace(3.0, 5.0, 50), indexing="ij")
    axes = {"Ixx": ("element", x.ravel()), "a": ("element", y.ravel())}
    status = ("element", np.zeros(x.size, np.uint8))
    z = np.sin(9.0 * x) * y
    ds = xr.Dataset({"misfit": ("element", z.ravel())}, {**axes, "status": status})
    ds.attrs["axes"] = ["Ixx", "a"]
    [mesh] = [c for c in sweeps.maps(ds, "misfit").axes[0].collections if c.get_array() is not None]
    np.testing.assert_array_equal(np.asarray(mesh.get_array()).reshape(50, 60), z.T)
