"""Results as objects of other libraries: pandas, xarray; each is imported on use.

The classes whose methods call this module import it. It imports none of them, so their objects are
`Any` here.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax import naming

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def estimates_frame(estimates: Mapping[str, Any]) -> "pd.DataFrame":
    """Return estimates as a data frame: a row each, with value, sd, lower95, upper95, unit,
    prior_share.

    sd and interval are NaN if a parameter is not identifiable.
    """
    import pandas as pd

    columns = ("value", "sd", "lower95", "upper95", "unit", "prior_share")
    rows = {name: [getattr(e, c) for c in columns] for name, e in estimates.items()}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=list(columns))
    numeric = [c for c in columns if c != "unit"]
    # None (not identifiable) becomes NaN. A column with None has dtype object, which pandas neither
    # sums nor plots.
    frame = frame.astype(dict.fromkeys(numeric, float))
    return frame.rename_axis("parameter")


def runs_frame(runs: Mapping[str, Mapping[str, Any]]) -> "pd.DataFrame":
    """Return the estimates of several runs as a long data frame: a row for each run and parameter.

    Parameters that are not identifiable have no number.
    """
    import pandas as pd

    frames = {run: estimates_frame(estimates) for run, estimates in runs.items()}
    frame = pd.concat(frames, names=["run"]).reset_index()
    frame.loc[frame["sd"].isna(), ["value", "lower95", "upper95"]] = np.nan
    return frame


def trajectory_dataset(run: Any) -> "xr.Dataset":
    """Return a run as a Dataset over `time` [s], with unit and role of each signal in the
    attributes.

    The role is state, output or input. An output that shares its name with a state or input becomes
    `NAME_output`; an input becomes `NAME_input`. In a batch, each signal has the dimensions
    `run_0`, `run_1` ... before time. The attribute `precision` is the floating-point type of the
    run.

    Raises:
        ValueError: the runs of a batch differ in their times.
    """
    import xarray as xr

    # vmap adds batch dimensions in front, so time is the last of every signal.
    times = np.asarray(run.times)
    batch = [f"run_{i}" for i in range(times.ndim - 1)]
    # A Dataset has one `time` coordinate for all runs.
    first = times.reshape(-1, times.shape[-1])[0]
    if not (times == first).all():
        raise ValueError("to_xarray: expected the same times in every run of the batch")
    variables: dict[str, Any] = {}
    for role, record in (("state", run.states), ("output", run.outputs), ("input", run.inputs)):
        for name, values in naming.asdict(record).items():
            # States come first and keep their names; `roll` is usually both state and output.
            unique = name if name not in variables else f"{name}_{role}"
            attributes = {"units": naming.unit(type(record), name) or "", "role": role}
            variables[unique] = ([*batch, "time"], np.asarray(values), attributes)
    status = (batch, np.asarray(run.status), {"meaning": "index into trajectory.STATUS"})
    coordinates = {"time": ("time", first, {"units": "s"}), "status": status}
    # The types in a file do not show the precision of the run, since float32 may have been widened.
    records = (run.states, run.outputs)
    types = {np.dtype(v.dtype) for r in records for v in naming.asdict(r).values()}
    floats = [t for t in types if t.kind == "f"]
    precision = min(floats, key=lambda t: t.itemsize, default=np.dtype(float)).name
    return xr.Dataset(variables, coordinates, {"precision": precision})
