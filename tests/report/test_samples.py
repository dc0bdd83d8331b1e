"""Draws of NUTS and samples of the bootstrap, in files and in the report."""

import dataclasses

import numpy as np
import pytest
import xarray as xr

from heli_jax.identification.uncertainty.bootstrap import Bootstrap
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.uncertainty.nuts import Convergence, Posterior
from heli_jax.report import tables
from heli_jax.report.files import SupplementaryAnalyses
from heli_jax.report.fit_page import Analysis, write_report
from heli_jax.report.origin import Origin
from heli_jax.report.sample_files import (
    posterior_tree,
    sample_files,
    write_samples,
)

MADE = Origin("heli-jax fit bench.yaml", "2026-11-23 16:00:00+00:00")


def gaussian_draws(fit, size):
    """Return draws of the fit's Gaussian approximation: normal in the logarithms."""
    names = list(fit.estimates)
    at = [fit.verdict.names.index(n) for n in names]
    covariance = fit.verdict.covariance[np.ix_(at, at)]
    rng = np.random.default_rng(0)
    away = rng.multivariate_normal(np.zeros(len(names)), covariance, size=size)
    return {n: fit.estimates[n].value * np.exp(away[..., i]) for i, n in enumerate(names)}


@pytest.fixture(scope="module")
def white(sound):
    """Return a fit with the sd of white residuals, as in its covariance."""
    fit, problem, baseline = sound
    estimates = {n: e._replace(sd=e.sd_white) for n, e in fit.estimates.items()}
    return dataclasses.replace(fit, estimates=estimates), problem, baseline


@pytest.fixture(scope="module")
def sampled(white):
    fit, shape = white[0], (4, 300)
    rng = np.random.default_rng(1)
    nuisance = {n: rng.normal(e.value, e.sd, shape) for n, e in fit.nuisance.items()}
    diverging = np.zeros(shape, bool)
    diverging[2, 17] = True
    statistics = {"diverging": diverging, "energy": rng.normal(size=shape)}
    convergence = {n: Convergence(1.002, 800.0) for n in fit.estimates}
    draws = gaussian_draws(fit, shape)
    posterior = Posterior(draws, convergence, 1, nuisance, statistics)
    booted = Bootstrap(gaussian_draws(fit, 90), 10, tuple(range(90)))
    by = {n: {"gaussian": (e.lower95, e.upper95)} for n, e in fit.estimates.items()}
    return Intervals(by, bootstrap=booted, posterior=posterior)


def test_the_tree_has_the_groups_and_units_that_arviz_looks_for(white, sampled):
    tree = posterior_tree(white[0], sampled.posterior, {"what": "draws"})
    assert set(tree.children) == {"posterior", "sample_stats"}
    Ixx = tree["posterior"]["Ixx"]
    assert Ixx.dims == ("chain", "draw")
    assert Ixx.attrs == {"units": "kg m^2", "role": "parameter"}
    roles = {v.attrs["role"] for v in tree["posterior"].data_vars.values()}
    assert roles == {"parameter", "nuisance"}
    # NetCDF takes a slash for a group; the fit's name is kept as an attribute.
    names = {v.attrs.get("long_name") for v in tree["posterior"].data_vars.values()}
    assert set(white[0].nuisance) <= names
    assert not any("/" in str(n) for n in tree["posterior"].data_vars)
    assert int(tree["sample_stats"]["diverging"].sum()) == 1


def test_draws_are_read_back_by_arviz(white, sampled, tmp_path):
    pytest.importorskip("h5netcdf")
    arviz = pytest.importorskip("arviz")
    write_samples(tmp_path, white[0], sampled, MADE, "bench.yaml")
    tree = arviz.from_netcdf(tmp_path / "posterior.nc")
    mine = sampled.posterior
    np.testing.assert_array_equal(tree["posterior"]["If"].values, mine.draws["If"])
    diverging = tree["sample_stats"]["diverging"].values
    assert diverging.dtype == bool
    np.testing.assert_array_equal(diverging, mine.statistics["diverging"])
    assert tree.attrs["command"] == MADE.command
    assert tree["posterior"].attrs["configuration"] == "bench.yaml"
    summary = arviz.summary(tree, var_names=["Ixx", "If"])
    assert float(summary.loc["Ixx", "r_hat"]) < 1.02


def test_the_bootstrap_is_a_file_of_its_own_that_says_what_it_is(white, sampled, tmp_path):
    alone = dataclasses.replace(sampled, posterior=None)
    write_samples(tmp_path, white[0], alone, MADE, "bench.yaml")
    assert [p.name for p in tmp_path.iterdir()] == ["bootstrap.nc"]
    read = xr.load_dataset(tmp_path / "bootstrap.nc", engine="scipy")
    assert "not draws from a posterior" in read.attrs["what"]
    assert read.attrs["records_that_could_not_be_fitted"] == 10
    assert read["If"].attrs["units"] == "kg m^2"
    np.testing.assert_array_equal(read["If"].values, sampled.bootstrap.values["If"])
    assert read.sizes == {"record": 90}


def test_nothing_is_written_where_nothing_was_sampled(white, sampled, tmp_path):
    none = dataclasses.replace(sampled, posterior=None, bootstrap=None)
    assert sample_files(None) == sample_files(none) == ()
    write_samples(tmp_path, white[0], none, MADE, "bench.yaml")
    assert list(tmp_path.iterdir()) == []
    # No record could be fitted, so there is no empty file.
    failed = dataclasses.replace(none, bootstrap=Bootstrap({"Ixx": np.array([])}, 5))
    assert sample_files(failed) == ()


def test_the_page_shows_chains_and_their_diagnostics(white, sampled, tmp_path):
    analysis = Analysis(*white, SupplementaryAnalyses(intervals=sampled))
    files = sample_files(sampled)
    assert files == ("posterior.nc", "bootstrap.nc")
    write_report(tmp_path, analysis, "bench", {}, MADE._replace(files=files))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'href="posterior.nc"' in page
    assert 'href="bootstrap.nc"' in page
    assert len(page) < 700_000
    table = tables.sampling(sampled.posterior)
    assert table.rows[0] == ("Ixx", "1.002", "800", "–")
    assert table.rows[-2][-1] == "1 of 1200"
