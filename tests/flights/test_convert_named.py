"""`heli-jax convert` of derived channels and presets."""

import numpy as np
import pytest

from heli_jax.cli import main
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.preset import by_preset

from .test_convert_and_info import table_of
from .test_presets import PHI, P, ardupilot_log


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return ardupilot_log(tmp_path_factory.mktemp("named") / "flight.bin")


def test_derived_channels(tmp_path):
    path, out = tmp_path / "log.csv", tmp_path / "out.csv"
    angle = np.linspace(0.0, 0.6, 60)
    # Half the angle about the roll axis; a heading that passes north.
    w, x, heading = np.cos(angle / 2), np.sin(angle / 2), (350 + np.arange(60)) % 360
    rows = zip(np.arange(60) / 50, w, x, heading, strict=True)
    lines = [f"{t:.2f},{float(a)!r},{float(b)!r},0,0,{c}" for t, a, b, c in rows]
    path.write_text("\n".join(["t,q[0],q[1],q[2],q[3],heading", *lines]))
    names = ["euler(q).roll", "unwrap(heading, 360)", "q*"]
    assert main(["convert", str(path), str(out), "--signals", *names]) == 0
    columns = table_of(out)
    assert list(columns) == ["time", *names[:2], "q[0]", "q[1]", "q[2]", "q[3]"]
    np.testing.assert_allclose(columns["euler(q).roll"], angle, atol=1e-12)
    np.testing.assert_array_equal(columns["unwrap(heading, 360)"], 350 + np.arange(60))
    assert convert_log(path, Selection(names)).units["euler(q).roll"] == "rad"


def test_the_signals_of_a_preset(log):
    converted = convert_log(log, Selection(named=by_preset("ardupilot-helicopter"), rate=100.0))
    assert {"roll_rate", "roll"} < set(converted.columns)
    np.testing.assert_allclose(converted.columns["roll_rate"], P, atol=1e-6)
    np.testing.assert_allclose(converted.columns["roll"], PHI, atol=1e-6)
    assert converted.units["roll_rate"] == "rad/s"
    [lacking] = [n for n in converted.notes if n.code == "channels.lacking"]
    assert "north" in lacking.subjects
