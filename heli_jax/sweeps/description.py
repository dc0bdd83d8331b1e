"""A sweep as plain data, so that a resumed one can be told from another."""

import hashlib
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from heli_jax.errors import InputError
from heli_jax.regular_file import read_regular
from heli_jax.sweeps import reducers
from heli_jax.sweeps.design import digest
from heli_jax.sweeps.reducers import Reduce
from heli_jax.sweeps.spec import Job, linear_inputs_of


def described(one: Job) -> dict[str, Any]:
    """What fixes the numbers of a sweep, as plain data; equal for two jobs that give the same."""
    model = one.model
    flights = [
        {
            "name": f.name,
            "samples": f.n_samples,
            "dt": f.dt,
            "known": dict(f.known),
            "sha256": digest({**f.inputs, **{f"measured {n}": v for n, v in f.outputs.items()}}),
            **({"linear": list(linear)} if (linear := linear_inputs_of(model, f)) else {}),
        }
        for f in one.flights
    ]
    kept = one.trajectories
    return {
        "model": model.name,
        "source": _source(model.vector_field),
        "vehicle": {n: v for n, v in one.params.items() if np.isfinite(v)},
        "flights": flights,
        "design": one.design.describe(),
        "reduce": {n: _reducer(r) for n, r in one.reduce.items()},
        "solver": one.solver,
        "substeps": one.substeps,
        "precision": one.precision,
        "trajectories": None if kept is None else [list(kept.signals), kept.every],
        "trimmed": None
        if one.trimmed is None
        else [
            [float(v) for v in one.trimmed.condition],
            list(one.trimmed.wind),
            one.trimmed.sticks,
        ],
        "pilot": None
        if one.pilot is None
        else digest({str(i): np.asarray(v) for i, v in enumerate(jax.tree.leaves(one.pilot))}),
    }


def _reducer(one: Reduce) -> dict[str, Any]:
    if isinstance(one.how, str):
        found: dict[str, Any] = {"how": one.how}
    else:
        how = one.how.update if isinstance(one.how, reducers.Streaming) else one.how
        found = {"how": getattr(how, "__qualname__", str(type(how))), "source": _source(how)}
    found |= {k: v for k, v in (("signal", one.signal), ("input", one.input)) if v is not None}
    return found | ({"gain": one.gain} if one.how == "margins" else {})


def _source(function: Callable[..., Any]) -> str:
    """A fingerprint of the file that a function comes from, where it is not one of ours: another
    program gives other numbers."""
    function = getattr(function, "func", function)
    module = getattr(function, "__module__", "") or ""
    if module.partition(".")[0] == "heli_jax":
        return ""
    try:
        file = inspect.getsourcefile(function)
        data = read_regular(file, "a module in Python", 10**7) if file else b""
        return hashlib.sha256(data).hexdigest() if file else ""
    except (TypeError, OSError, InputError):
        return ""


def differences(old: Mapping[str, Any], new: Mapping[str, Any], above: str = "") -> list[str]:
    """The keys in which two descriptions differ, each with what was and what is."""
    found = []
    for key in {**old, **new}:
        a, b = old.get(key), new.get(key)
        if a == b:
            continue
        if isinstance(a, dict) and isinstance(b, dict):
            found += differences(a, b, f"{above}{key}.")
        else:
            found.append(f"{above}{key} was {_short(a)} and is {_short(b)}")
    return found


def _short(value: Any) -> str:
    if value is None:
        return "not given"
    text = str(value)
    return text if len(text) <= 40 else text[:37] + "..."
