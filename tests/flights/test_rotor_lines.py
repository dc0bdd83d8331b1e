"""Lines of vibration in a log that has the rotor's speed, as `info` names them."""

import json

import numpy as np
import pytest

from heli_jax.cli import main
from heli_jax.flights.open_log import open_log
from heli_jax.flights.vibration import rotor_lines

from . import log_writers as writers

MESSAGES = {
    "RATE": (150, "Qffffff", "TimeUS,RDes,R,ROut,PDes,P,POut"),
    "RPM": (153, "Qff", "TimeUS,rpm1,rpm2"),
}


def shaken(path, rpm):
    """24 s: rates at 200 Hz with 1/rev at 25 Hz and a line of 41 Hz, the rotor's speed at 10 Hz."""
    t = np.arange(4800) / 200
    slow = 10 * np.sin(2 * np.pi * 0.3 * t)
    p = slow + 3 * np.sin(2 * np.pi * 25 * t) + 2 * np.sin(2 * np.pi * 41 * t + 1)
    p += np.random.default_rng(0).standard_normal(t.size)
    us = (1e6 * (5 + t)).astype(int)
    rows = [("RATE", (k, 0, x, y, 0, y, y)) for k, x, y in zip(us, p, slow, strict=True)]
    rows += [("RPM", (k, x, 0)) for k, x in zip(us[::20], rpm(t[::20]), strict=True)]
    path.write_bytes(writers.dataflash(MESSAGES, sorted(rows, key=lambda row: row[1][0])))
    return p


def test_lines_are_named_while_the_rotor_is_steady(tmp_path, capsys):
    path = tmp_path / "flight.bin"
    p = shaken(path, lambda t: np.minimum(500 * t, 1500 + 5 * np.sin(t)))
    found = rotor_lines(open_log(path))
    assert found.hz == pytest.approx(25.0, rel=2e-3)
    # Steady but for 3 % from 1455 rpm on.
    assert (found.start, found.end) == pytest.approx((3.0, 23.9), abs=0.1)
    roll, pitch = found.signals
    assert (roll.signal, roll.channel, pitch.lines) == ("roll_rate", "RATE.R", ())
    first, second = roll.lines
    np.testing.assert_allclose([first.hz, second.hz], [25.0, 41.0], atol=0.13)
    np.testing.assert_allclose([first.share, second.share], [4.5, 2.0] / np.var(p), rtol=0.2)
    assert (first.harmonic, second.harmonic) == (1, 0)
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert f"rotor: {found.hz:.4g} Hz by RPM.rpm1, steady from 3 s to 23.9 s" in text
    assert "  RATE.R: 25 Hz has " in text
    assert "(1/rev of the rotor)" in text
    assert "(no harmonic of the rotor)" in text
    assert "no line above 1 % of the variance: RATE.P" in text
    assert main(["info", str(path), "--json"]) == 0
    (flight,) = json.loads(capsys.readouterr().out)["flights"]
    line = flight["vibration"]["signals"][0]["lines"][0]
    assert line == first._asdict() | {"aliased": False}


def test_a_rotor_that_is_not_steady_is_said(tmp_path, capsys):
    path = tmp_path / "flight.bin"
    shaken(path, lambda t: 1500 + 300 * np.sin(t))
    assert rotor_lines(open_log(path)).signals == ()
    assert main(["info", str(path)]) == 0
    assert "rotor: RPM.rpm1 is not steady for 8 s, no lines are named" in capsys.readouterr().out
    shaken(path, np.zeros_like)
    assert main(["info", str(path), "--json"]) == 0
    (flight,) = json.loads(capsys.readouterr().out)["flights"]
    assert flight["vibration"]["hz"] is None
