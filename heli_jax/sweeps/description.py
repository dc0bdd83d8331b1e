"""Description of a sweep as plain data, for the check of a resumed one."""

import hashlib
import inspect
import json
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from heli_jax.errors import InputError
from heli_jax.regular_file import read_regular
from heli_jax.sweeps import reducers
from heli_jax.sweeps.design import digest
from heli_jax.sweeps.reducers import Reduce
from heli_jax.sweeps.spec import Job, moving_inputs_of


def described(job: Job) -> dict[str, Any]:
    """Return the data that define the numbers of a sweep; equal for jobs with equal numbers."""
    # Stored with each sweep and compared on resumption. A renamed key or another text for the same
    # thing would refuse all existing stores. Large arrays are stored as a digest.
    model = job.model
    flights = [
        {
            "name": f.name,
            "samples": f.n_samples,
            "dt": f.dt,
            "known": dict(f.known),
            "sha256": digest({**f.inputs, **{f"measured {n}": v for n, v in f.outputs.items()}}),
            "holds": dict(moving_inputs_of(model, f)),
        }
        for f in job.flights
    ]
    kept = job.options.trajectories
    return {
        "model": model.name,
        "source": _source(model.vector_field),
        # A missing constant is NaN, which JSON lacks and which does not equal itself.
        "vehicle": {n: v for n, v in job.params.items() if np.isfinite(v)},
        "flights": flights,
        "design": job.design.description,
        "reduce": {n: _reducer(r) for n, r in job.reduce.items()},
        "solver": job.options.solver,
        "substeps": job.options.substeps,
        "precision": job.options.precision,
        "trajectories": None if kept is None else [list(kept.signals), kept.every],
        "trimmed": None
        if job.options.trimmed is None
        else [
            [float(v) for v in job.options.trimmed.condition],
            list(job.options.trimmed.wind),
            job.options.trimmed.sticks,
        ],
        "pilot": None
        if job.options.pilot is None
        else digest(
            {str(i): np.asarray(v) for i, v in enumerate(jax.tree.leaves(job.options.pilot))}
        ),
    }


def _reducer(reduce: Reduce) -> dict[str, Any]:
    reducer = reduce.how
    if isinstance(reducer, str):
        words: dict[str, Any] = {"how": reducer}
    else:
        function = reducer.update if isinstance(reducer, reducers.Streaming) else reducer
        # A name and a digest: the repr of a function has its address in memory.
        name = getattr(function, "__qualname__", str(type(function)))
        words = {"how": name, "source": _source(function)}
    words |= {
        k: v for k, v in (("signal", reduce.signal), ("input", reduce.input)) if v is not None
    }
    return words | ({"gain": reduce.gain} if reducer == "margins" else {})


def _source(function: Callable[..., Any]) -> str:
    """Return a digest of the file of a user's function: another program gives other numbers.

    It is empty for functions of heli_jax.
    """
    function = getattr(function, "func", function)  # of a functools.partial
    module = getattr(function, "__module__", "") or ""
    # Our own change with the version, which is stored; a new comment must not stop a sweep.
    if module.partition(".")[0] == "heli_jax":
        return ""
    try:
        file = inspect.getsourcefile(function)
        data = read_regular(file, "a module in Python", 10**7) if file else b""
        return hashlib.sha256(data).hexdigest() if file else ""
    except (TypeError, OSError, InputError):
        # Typed into a session, or compiled: there is no file, and only the name identifies it.
        return ""


def require_same(old: Mapping[str, Any], new: Mapping[str, Any], where: str) -> None:
    """Refuse to continue with another description.

    Raises:
        InputError: naming the first key in which the two differ; `where` begins the sentence.
    """
    # Through JSON like the stored one, where a tuple becomes a list.
    changes = _differences(old, json.loads(json.dumps(new)))
    if changes:
        more = f" (and {len(changes) - 1} more)" if len(changes) > 1 else ""
        raise InputError(f"{where}: {changes[0]}{more}; expected the same, or another --out")


def _differences(old: Mapping[str, Any], new: Mapping[str, Any], above: str = "") -> list[str]:
    """Return the keys in which two descriptions differ, each with the old and the new value."""
    changes = []
    for key in {**old, **new}:
        a, b = old.get(key), new.get(key)
        if a == b:
            continue
        if isinstance(a, dict) and isinstance(b, dict):
            changes += _differences(a, b, f"{above}{key}.")
        else:
            changes.append(f"{above}{key} was {_short(a)} and is {_short(b)}")
    return changes


def _short(value: object) -> str:
    if value is None:
        return "not given"
    text = str(value)
    return text if len(text) <= 40 else text[:37] + "..."
