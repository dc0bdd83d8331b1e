"""A text whose names and units both stand in comments, as NumPy and flight test write them."""

import numpy as np
import pytest

from heli_jax.flights.describe import describe_flights
from heli_jax.new_config import write_config

T = np.arange(400) * 0.01
STICK = 0.3 * np.sign(np.sin(T * 5))
RATE = np.degrees(0.4 * np.sin(T * 5 - 0.5))
ROWS = np.column_stack([T, STICK, RATE])


def _saved(path, header, **more):
    np.savetxt(path, ROWS, "%.6g", header=header, **more)
    return path


@pytest.mark.parametrize(
    ("header", "more"),
    [
        ("t DLAT P\ns - deg/s", {}),
        ("Flight 7\nt   DLAT P\n[s] [-] [deg/s]", {"comments": "% "}),
        ("t,DLAT,P\ns,-,deg/s", {"delimiter": ","}),
        ("t,DLAT,P\ns,-,°/s", {"delimiter": ",", "encoding": "utf-8"}),
    ],
)
def test_the_upper_comment_names_and_the_lower_has_units(tmp_path, header, more):
    (info,) = describe_flights(_saved(tmp_path / "flight.asc", header, **more))
    assert [c.name for c in info.columns] == ["t", "DLAT", "P"]
    assert (info.columns[0].unit, info.columns[2].unit) in (("s", "deg/s"), ("s", "°/s"))
    assert info.n_rows == T.size
    np.testing.assert_allclose(info.columns[2].max, RATE.max(), rtol=1e-4)


@pytest.mark.parametrize("header", ["a title\nt DLAT P", "t DLAT P", "m s deg\nt DLAT P"])
def test_a_comment_of_names_alone_is_read_as_it_was(tmp_path, header):
    (info,) = describe_flights(_saved(tmp_path / "flight.asc", header))
    assert [c.name for c in info.columns] == ["t", "DLAT", "P"]


def test_new_takes_names_and_units_from_it(tmp_path):
    log, out = _saved(tmp_path / "flight.asc", "t DLAT P\ns - deg/s"), tmp_path / "new.yaml"
    write_config(log, out)
    words = out.read_text()
    assert 'lat: {signal: DLAT, unit: "-"}' in words
    assert "p: {signal: P, unit: deg/s}" in words
