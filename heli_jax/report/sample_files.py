"""Files of posterior draws and bootstrap samples: posterior.nc and bootstrap.nc."""

import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax.errors import InputError
from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.bootstrap import Bootstrap
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.uncertainty.nuts import Posterior
from heli_jax.report.origin import Origin
from heli_jax.versions import version

if TYPE_CHECKING:
    import xarray as xr

POSTERIOR, BOOTSTRAP = "posterior.nc", "bootstrap.nc"
_WHAT = {
    POSTERIOR: "Draws from the posterior by the No-U-Turn sampler, without warm-up. The prior is "
    "flat in the optimiser's coordinates (the logarithm of a parameter of fixed "
    "sign), times the priors of the configuration. The noise scale is integrated out "
    "(Jeffreys' prior) and has no draws.",
    BOOTSTRAP: "Estimates from records that were drawn from the fit (in time simulated with its "
    "estimates, in frequency from its residuals): the scatter of the estimator. They "
    "are not draws from a posterior.",
}
_STATISTICS = {
    "diverging": "true if the energy error of the trajectory was too large",
    "energy": "of the trajectory, up to a constant",
    "acceptance_rate": "mean acceptance probability over the trajectory",
    "n_steps": "steps of the integrator",
    "tree_depth": "doublings of the trajectory",
    "lp": "log density in the optimiser's coordinates, up to a constant",
    "step_size": "of the integrator, in units of the Gaussian approximation's sd",
}
type _Variables = dict[str, tuple[Any, np.ndarray, dict[str, str]]]


def sample_files(comparison: Intervals | None) -> tuple[str, ...]:
    """Return the names of the files written by `write_samples`."""
    if comparison is None:
        return ()
    posterior = (POSTERIOR,) if comparison.posterior is not None else ()
    booted = comparison.bootstrap is not None and comparison.bootstrap.records
    return posterior + ((BOOTSTRAP,) if booted else ())


def write_samples(
    folder: Path, fit: Fit, comparison: Intervals | None, origin: Origin, config: str
) -> None:
    """Write posterior.nc (NetCDF 4, for arviz) and bootstrap.nc (NetCDF 3), if sampled.

    Raises:
        InputError: h5netcdf is not installed (extra `bayes`).
    """
    names = sample_files(comparison)
    if comparison is None or not names:
        return
    attributes = {
        "inference_library": "heli_jax",
        "inference_library_version": version(),
        "created_at": origin.date,
        "command": origin.command,
        "configuration": config,
        "model": fit.model,
        "method": fit.method_label,
    }
    if comparison.posterior is not None:
        about = {"what": _WHAT[POSTERIOR], **attributes}
        tree = posterior_tree(fit, comparison.posterior, about)
        if importlib.util.find_spec("h5netcdf") is None:
            raise InputError(
                "posterior.nc: h5netcdf is not installed, expected the extra bayes: "
                "pip install 'heli_jax[bayes]'"
            )
        tree.to_netcdf(folder / POSTERIOR, engine="h5netcdf")
    if comparison.bootstrap is not None and BOOTSTRAP in names:
        about = {"what": _WHAT[BOOTSTRAP], **attributes}
        dataset = bootstrap_dataset(fit, comparison.bootstrap, about)
        dataset.to_netcdf(folder / BOOTSTRAP, engine="scipy")


def posterior_tree(fit: Fit, posterior: Posterior, attributes: Mapping[str, str]) -> "xr.DataTree":
    """Return the draws in the format of arviz, in the groups posterior and sample_stats."""
    import xarray as xr

    dims = ("chain", "draw")
    draws: _Variables = {
        name: (dims, v, {"units": fit.estimates[name].unit, "role": "parameter"})
        for name, v in posterior.draws.items()
    }
    for name, values in posterior.nuisance.items():
        known = fit.nuisance.get(name)
        about = {"units": known.unit if known else "1", "role": "nuisance", "long_name": name}
        draws[_variable(name, draws)] = (dims, values, about)
    statistics: _Variables = {
        name: (dims, values, {"long_name": _STATISTICS.get(name, name)})
        for name, values in posterior.statistics.items()
    }
    chains, count = next(iter(posterior.draws.values())).shape
    coordinates = {"chain": np.arange(chains), "draw": np.arange(count)}
    groups = {
        # arviz reads single groups, so each has the attributes.
        "/": xr.Dataset(attrs=dict(attributes)),
        "posterior": xr.Dataset(draws, coordinates, dict(attributes)),
        "sample_stats": xr.Dataset(statistics, coordinates, dict(attributes)),
    }
    return xr.DataTree.from_dict(groups)


def bootstrap_dataset(fit: Fit, booted: Bootstrap, attributes: Mapping[str, str]) -> "xr.Dataset":
    """Return the bootstrap samples by parameter and record number."""
    import xarray as xr

    variables: _Variables = {
        name: ("record", v, {"units": fit.estimates[name].unit, "role": "parameter"})
        for name, v in booted.values.items()
    }
    record = ("record", np.array(booted.records, np.int32), {"long_name": "simulated record"})
    counts = {"records_that_could_not_be_fitted": booted.failures}
    return xr.Dataset(variables, {"record": record}, {**attributes, **counts})


def _variable(name: str, taken: Mapping[str, Any]) -> str:
    """Return a name without slashes, which would start a NetCDF group."""
    plain = re.sub(r"\W+", "_", name).strip("_") or "nuisance"
    plain = f"_{plain}" if plain[0].isdigit() else plain
    unique, k = plain, 2
    while unique in taken:
        unique, k = f"{plain}_{k}", k + 1
    return unique
