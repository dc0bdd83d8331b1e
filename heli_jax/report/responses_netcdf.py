"""Responses as NetCDF, with their units."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from heli_jax.analysis.flight_responses import FlightResponses


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

    def stacked(name: str) -> np.ndarray:
        return np.stack(
            [[getattr(o.pairs[i], name) for i in inputs] for o in responses.outputs.values()]
        )

    pairs, each = ("output", "input", "frequency"), ("output", "frequency")
    H, picture = stacked("H"), stacked("picture")
    unit = [[quotient(units[o], units[i]) for i in inputs] for o in responses.outputs]
    one = {u for row in unit for u in row}
    # An attribute is that of all pairs; where these differ the coordinate `unit` has each.
    of_H = {"units": one.pop()} if len(one) == 1 else {}
    parts = "in the coordinate unit, output over input"

    def described(words: str) -> dict[str, str]:
        return {"long_name": f"{words}, {parts}", **of_H}

    data = xr.Dataset(
        {
            # NetCDF 3 has no complex numbers.
            "real": (pairs, np.real(H), described("real part")),
            "imaginary": (pairs, np.imag(H), described("imaginary part")),
            "sd": (pairs, stacked("sd"), described("of the real and of the imaginary part")),
            "half95": (
                "output",
                [next(iter(o.pairs.values())).half95 for o in responses.outputs.values()],
                {"long_name": "half of a 95 % interval in sd", "units": "1"},
            ),
            "coherence": (
                pairs,
                stacked("coherence"),
                {"long_name": "partial coherence", "units": "1"},
            ),
            "composite_real": (
                pairs,
                np.real(picture),
                described("real part of several windows"),
            ),
            "composite_imaginary": (
                pairs,
                np.imag(picture),
                described("imaginary part of several windows"),
            ),
            "multiple_coherence": (
                each,
                np.stack([o.multiple for o in responses.outputs.values()]),
                {"long_name": "coherence with all inputs together", "units": "1"},
            ),
            "noise": (
                each,
                np.stack([o.noise for o in responses.outputs.values()]),
                {"long_name": "density of what the inputs leave", "units": "SI^2/Hz"},
            ),
        },
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
        },
    )
    data.to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")


def quotient(output: str, input: str) -> str:
    """The unit of output over input."""
    if input == "1":
        return output
    return f"{output}/({input})" if "/" in input else f"{output}/{input}"
