"""Responses as NetCDF, with their units."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from heli_jax.analysis.flight_responses import FlightResponses
from heli_jax.finding import as_data

type _Variable = tuple[tuple[str, ...], np.ndarray, dict[str, str]]
"""its dimensions, its values and what is said of it"""


def write_netcdf(path: Path, responses: FlightResponses, units: Mapping[str, str]) -> None:
    """Write responses.nc.

    Args:
        path: of the file.
        responses: the responses.
        units: SI, of inputs and outputs by name.
    """
    # Here: it takes long to load, for this file alone.
    import xarray as xr

    inputs = list(next(iter(responses.outputs.values())).pairs)
    unit = [[quotient(units[o], units[i]) for i in inputs] for o in responses.outputs]
    data = xr.Dataset(
        {**_of_pairs(responses, inputs, unit), **_of_outputs(responses)},
        {
            "output": list(responses.outputs),
            "input": inputs,
            "unit": (("output", "input"), unit),
            "frequency": ("frequency", responses.omega / (2.0 * np.pi), {"units": "Hz"}),
        },
        {
            "window_s": responses.window,
            "instruments": " ".join(responses.instruments),
            "units_of_outputs": " ".join(units[n] for n in responses.outputs),
            "units_of_inputs": " ".join(units[n] for n in inputs),
            "notes": json.dumps([as_data(f) for f in responses.notes]),
        },
    )
    data.to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")


def _of_pairs(
    responses: FlightResponses, inputs: Sequence[str], unit: Sequence[Sequence[str]]
) -> dict[str, _Variable]:
    """What there is of each output and input; `unit` of each, by output."""

    def stacked(name: str) -> np.ndarray:
        return np.stack(
            [[getattr(o.pairs[i], name) for i in inputs] for o in responses.outputs.values()]
        )

    one = {u for row in unit for u in row}
    # An attribute is that of all pairs; where these differ the coordinate `unit` has each.
    of_H = {"units": one.pop()} if len(one) == 1 else {}
    parts = "in the coordinate unit, output over input"
    pairs, H, picture = ("output", "input", "frequency"), stacked("H"), stacked("picture")
    # NetCDF 3 has no complex numbers.
    described = {
        "real": (np.real(H), "real part"),
        "imaginary": (np.imag(H), "imaginary part"),
        "sd": (stacked("sd"), "of the real and of the imaginary part"),
        "composite_real": (np.real(picture), "real part of several windows"),
        "composite_imaginary": (np.imag(picture), "imaginary part of several windows"),
    }
    made: dict[str, _Variable] = {
        name: (pairs, values, {"long_name": f"{words}, {parts}", **of_H})
        for name, (values, words) in described.items()
    }
    words = {"long_name": "partial coherence", "units": "1"}
    return made | {"coherence": (pairs, stacked("coherence"), words)}


def _of_outputs(responses: FlightResponses) -> dict[str, _Variable]:
    """What there is of each output."""
    outputs, each = responses.outputs.values(), ("output", "frequency")
    return {
        "half95": (
            ("output",),
            np.array([next(iter(o.pairs.values())).half95 for o in outputs]),
            {"long_name": "half of a 95 % interval in sd", "units": "1"},
        ),
        "multiple_coherence": (
            each,
            np.stack([o.multiple for o in outputs]),
            {"long_name": "coherence with all inputs together", "units": "1"},
        ),
        "noise": (
            each,
            np.stack([o.noise for o in outputs]),
            {"long_name": "density of what the inputs leave", "units": "SI^2/Hz"},
        ),
    }


def quotient(output: str, input: str) -> str:
    """The unit of output over input."""
    if input == "1":
        return output
    return f"{output}/({input})" if "/" in input else f"{output}/{input}"
