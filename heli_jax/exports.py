"""Results as the objects of other libraries: pandas, xarray; each imported where it is used.

The classes whose methods call this import it, so that it imports none of them: their objects are
`Any` here.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax import naming
from heli_jax.summaries import precision_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def estimates_frame(estimates: Mapping[str, Any]) -> "pd.DataFrame":
    """Estimates as a data frame: a row each, with value, sd, lower95, upper95, unit, prior_share.

    sd and interval are NaN where the data do not determine a parameter.
    """
    import pandas as pd

    columns = ("value", "sd", "lower95", "upper95", "unit", "prior_share")
    rows = {name: [getattr(e, c) for c in columns] for name, e in estimates.items()}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=list(columns))
    numeric = [c for c in columns if c != "unit"]
    # None, where the data do not determine a parameter, becomes NaN: a column with None is of
    # objects, which pandas neither sums nor plots.
    frame = frame.astype(dict.fromkeys(numeric, float))
    return frame.rename_axis("parameter")


def runs_frame(runs: Mapping[str, Mapping[str, Any]]) -> "pd.DataFrame":
    """The estimates of several runs as a long data frame: a row for each run and parameter.

    What the data do not determine has no number.
    """
    import pandas as pd

    frames = {run: estimates_frame(estimates) for run, estimates in runs.items()}
    frame = pd.concat(frames, names=["run"]).reset_index()
    frame.loc[frame["sd"].isna(), ["value", "lower95", "upper95"]] = np.nan
    return frame


def trajectory_dataset(run: Any) -> "xr.Dataset":
    """A run as a Dataset over `time` [s], each signal with its unit and its role (state, output or
    input) in the attributes.

    An output of the same name as a state or input, whose values it would repeat or replace, is
    `NAME_output`; an input likewise `NAME_input`. Of a batch of runs each signal has further
    dimensions `run_0`, `run_1` ... before time. The attribute `precision` is the type that the run
    was computed in; where that is below float64, `precision_note` says what it costs.

    Raises:
        ValueError: the runs of a batch differ in their times.
    """
    import xarray as xr

    # vmap puts batch dimensions in front, so time is the last of every signal.
    times = np.asarray(run.times)
    batch = [f"run_{i}" for i in range(times.ndim - 1)]
    # One coordinate for all runs: a Dataset has no `time` that differs from run to run.
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
    # A file of it does not say in which precision its numbers were computed: single ones may have
    # been widened since.
    precision, cost = precision_of(run)
    attributes = {"precision": precision} | ({"precision_note": cost} if cost else {})
    return xr.Dataset(variables, coordinates, attributes)
