"""heli_jax: physical parameters of small helicopters from logged runs, with honest uncertainties.

Units are SI throughout. Switch to float64 first: `jax.config.update("jax_enable_x64", True)`.
Importing the package changes no setting; names are loaded on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

# Type checkers and editors do not evaluate __getattr__; `as` marks a name as exported.
if TYPE_CHECKING:
    from heli_jax import models as models
    from heli_jax.analysis.linear import linearize as linearize
    from heli_jax.analysis.lti import c2d as c2d
    from heli_jax.analysis.lti import d2c as d2c
    from heli_jax.analysis.trim import trim as trim
    from heli_jax.control_workflow import run_control as run_control
    from heli_jax.design_workflow import run_design as run_design
    from heli_jax.dynamics.model import Model as Model
    from heli_jax.flights import Flight as Flight
    from heli_jax.flights import Signal as Signal
    from heli_jax.flights import read_flight as read_flight
    from heli_jax.identification.equation_error.rls import rls as rls
    from heli_jax.identification.fit import check as check
    from heli_jax.identification.fit import fit as fit
    from heli_jax.identification.flight_design import InputLimit as InputLimit
    from heli_jax.identification.flight_design import Limits as Limits
    from heli_jax.identification.flight_design import design as design
    from heli_jax.identification.problem import Free as Free
    from heli_jax.identification.problem import Nuisance as Nuisance
    from heli_jax.identification.problem import Prior as Prior
    from heli_jax.identification.problem import Problem as Problem
    from heli_jax.identification.result import Fit as Fit
    from heli_jax.identification.uncertainty.comparison import intervals as intervals
    from heli_jax.linear_models.read import LinearModel as LinearModel
    from heli_jax.linear_models.read import linear_model as linear_model
    from heli_jax.report.compared_runs import compare_runs as compare_runs
    from heli_jax.report.saved_fit import SavedFit as SavedFit
    from heli_jax.report.saved_fit import load_fit as load_fit
    from heli_jax.simulation.accumulate import accumulate as accumulate
    from heli_jax.simulation.options import SimulationOptions as SimulationOptions
    from heli_jax.simulation.simulate import simulate as simulate
    from heli_jax.simulation.trajectory import Trajectory as Trajectory
    from heli_jax.studies.run import run_study as run_study
    from heli_jax.sweep_workflow import run_sweep as run_sweep
    from heli_jax.sweeps.run import sweep as sweep
    from heli_jax.vehicle import Helicopter as Helicopter
    from heli_jax.vehicle import load_vehicle as load_vehicle
    from heli_jax.workflow import FitRun as FitRun
    from heli_jax.workflow import compare_models as compare_models
    from heli_jax.workflow import load_config as load_config
    from heli_jax.workflow import run_check as run_check
    from heli_jax.workflow import run_fit as run_fit
    from heli_jax.workflow import write_report as write_report

# Modules of the names, loaded on first use. Otherwise `import heli_jax` and `heli-jax --help` would
# wait seconds for JAX, diffrax and xarray.
_HOMES = {
    name: home
    for home, names in {
        "vehicle": "Helicopter load_vehicle",
        "dynamics.model": "Model",
        "": "models",
        "linear_models.read": "LinearModel linear_model",
        "flights": "Flight Signal read_flight",
        "simulation.simulate": "simulate",
        "simulation.options": "SimulationOptions",
        "simulation.accumulate": "accumulate",
        "sweeps.run": "sweep",
        "identification.problem": "Problem Free Prior Nuisance",
        "identification.fit": "check fit",
        "identification.flight_design": "InputLimit Limits design",
        "control_workflow": "run_control",
        "design_workflow": "run_design",
        "identification.equation_error.rls": "rls",
        "analysis.lti": "c2d d2c",
        "analysis.linear": "linearize",
        "analysis.trim": "trim",
        "identification.result": "Fit",
        "simulation.trajectory": "Trajectory",
        "identification.uncertainty.comparison": "intervals",
        "report.saved_fit": "SavedFit load_fit",
        "report.compared_runs": "compare_runs",
        "workflow": "FitRun compare_models load_config run_check run_fit write_report",
        "studies.run": "run_study",
        "sweep_workflow": "run_sweep",
    }.items()
    for name in names.split()
}


__all__ = [*_HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:  # Any: the names have different types.
    if name == "__version__":
        from heli_jax.versions import version

        return version()
    if name not in _HOMES:
        raise AttributeError(f"module 'heli_jax' has no attribute {name!r}")
    # `models` is itself a module.
    if name == "models":
        return importlib.import_module("heli_jax.models")
    return getattr(importlib.import_module(f"heli_jax.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    # Completion in a session needs all names, not only those already used.
    return sorted([*_HOMES, "__version__"])
