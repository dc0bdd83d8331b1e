"""heli-jax compatibility: sensor errors estimated, written, and removed from the signals."""

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from heli_jax import Prior, compatibility, config
from heli_jax.cli import main
from heli_jax.finding import note
from heli_jax.identification.result import Estimate
from heli_jax.identification.validation.adequacy import OutputAdequacy

RATE, DURATION = 25.0, 16.0
BIAS, SCALE, LATE = 1.5, 0.08, 0.04
"""Errors: bias of the roll gyro [deg/s], its scale, and delay of the angles [s]."""


@pytest.fixture(scope="module")
def true():
    """Return time [s], rates [rad/s] and delayed angles [rad] of a motion in closed form."""
    path = Path(__file__).parents[1] / "experiments" / "data_compatibility.py"
    motion = runpy.run_path(str(path))["Motion"](np.random.default_rng(5))
    t = np.arange(round(DURATION * RATE)) / RATE
    return t, motion.omega(t), motion.angles(t - LATE)


@pytest.fixture
def folder(tmp_path, true):
    """Return a log with a wrong roll gyro, and its configuration."""
    t, omega, angles = true
    rng = np.random.default_rng(1)
    rates = np.degrees(omega + 0.004 * rng.standard_normal(omega.shape))
    rates[:, 0] = (1 + SCALE) * rates[:, 0] + BIAS
    # A compass shows yaw from -180 to 180 degrees.
    shown = np.degrees(angles + np.array([0, 0, 3.0]) + 0.004 * rng.standard_normal(angles.shape))
    shown[:, 2] = (shown[:, 2] + 180.0) % 360.0 - 180.0
    columns = np.column_stack([t, rates, shown])
    np.savetxt(
        tmp_path / "log.csv", columns, delimiter=",", comments="",
        header="t,gx,gy,gz,roll,pitch,yaw", fmt="%.9g",
    )  # fmt: skip
    return tmp_path


def configured(folder, name="sensors.yaml", **more):
    def named(pairs):
        return {n: {"signal": s, "unit": u} for n, s, u in pairs}

    signals = {
        "time": {"signal": "t"},
        "inputs": named([("p", "gx", "deg/s"), ("q", "gy", "deg/s"), ("r", "gz", "deg/s")]),
        "outputs": named(
            [("phi", "roll", "deg"), ("theta", "pitch", "deg"), ("psi", "yaw", "deg")]
        ),
    }
    content = {
        "model": "kinematics",
        "flights": [{"log": "log.csv", "signals": signals} | more.pop("flight", {})],
    } | more
    path = folder / name
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def test_a_model_of_the_machine_is_refused(folder, capsys):
    path = configured(folder, model={"linear": "roll-flybarless"})
    assert main(["compatibility", str(path), "--out", str(folder / "out")]) == 2
    assert not (folder / "out").exists()


def fitted(folder, estimates, shares, status="converged", noise=0.005) -> Any:
    """Return a fit with given errors (value, half of the interval) and R2 of outputs."""
    experiment = config.load(configured(folder))
    y = np.sin(np.arange(100.0))
    left = {n: y - np.sqrt(1 - r) * (y - y.mean()) for n, r in shares.items()}
    signals = SimpleNamespace(measured=dict.fromkeys(shares, y), simulated=left, hold_out=False)
    of_machine = note("adequacy.of-machine", "of a machine")
    fit = SimpleNamespace(
        estimates={
            n: Estimate(v, 0.5 * w, v - w, v + w, "1", 0.0, 0.9 if n == "b_r" else 0.0, False)
            for n, (v, w) in estimates.items()
        },
        verdict=SimpleNamespace(resting=()),
        status=status,
        signals=[signals],
        findings=(note("of.fit", "of the fit"), of_machine),
        adequacy=SimpleNamespace(
            judged=[OutputAdequacy(n, True, r, 1.0, True, 0.0, 0.4) for n, r in shares.items()],
        ),
        method="filter-error",
    )
    # Third differences show half of the estimated noise, unless `noise` differs.
    free = {"noise_gyro": SimpleNamespace(start=noise)}
    free["b_r"] = SimpleNamespace(prior=Prior(0.0, 0.05))
    problem = SimpleNamespace(
        flights=config.read_flights(experiment), free=free, noise_model="disturbance"
    )
    return SimpleNamespace(config=experiment, fit=fit, problem=problem)


def test_what_a_fit_says_of_the_sensors(folder):
    found = {"lambda_p": (0.23, 0.004), "b_p": (0.001, 0.002), "b_r": (0.1, 0.01),
             "noise_gyro": (0.01, 0.001), "delay_gyro": (0.04, 0.01)}  # fmt: skip

    def judged(shares, changed=found, **how):
        return compatibility.judged(fitted(folder, changed, shares, **how))

    sound = judged({"phi": 0.99, "psi": 0.95})
    assert sound.compatible
    assert [(d.code, d.value) for d in sound.doubts[:1]] == [("sensors.scale-too-large", 0.23)]
    assert [d.code for d in sound.doubts[1:]] == ["of.fit"]
    signals = sound.corrections["signals"]
    assert signals["phi"] == {
        "signal": "roll", "unit": "deg", "scale": 1.0, "offset": 0.0, "delay": 0.04
    }  # fmt: skip
    assert sound.corrections["not_determined"] == ["b_r"]
    assert compatibility._agreement(sound).doubts == sound.doubts[:1]  # also on the fit's page
    bad = judged({"phi": 0.99, "psi": 0.2})
    assert not bad.compatible
    assert not bad.corrections["signals"]
    # The integrated gyro noise lets an angle drift, although the vehicle hardly moves.
    drifts = judged({"phi": 0.99, "psi": 0.8}, noise=0.009)
    assert drifts.compatible
    assert drifts.corrections["signals"]
    lost = judged({"phi": 0.99}, status="not-converged")
    assert not lost.compatible
    assert not lost.corrections["signals"]


@pytest.mark.parametrize("how", [{}, {"scale": 2.0, "offset": 3.0, "invert": True}])
def test_the_written_conversion_removes_the_errors(folder, true, how):
    errors = {"lambda_p": (SCALE, 0.001), "b_p": (np.radians(BIAS), 1e-4), "x_imu": (0.2, 0.01)}
    run = fitted(folder, errors, {"phi": 0.99})
    path = configured(folder)
    content = yaml.safe_load(path.read_text())
    signals = content["flights"][0]["signals"]
    if how:
        # The log of another gyro, whose numbers need a conversion.
        log = np.genfromtxt(folder / "log.csv", delimiter=",", names=True)
        log["gx"] = log["gx"] / -2.0 + 3.0
        np.savetxt(folder / "log.csv", log, delimiter=",", comments="",
                   header=",".join(log.dtype.names))  # fmt: skip
        signals["inputs"]["p"] |= how
        path.write_text(yaml.safe_dump(content))
    run.problem.flights = config.read_flights(config.load(path))
    written = compatibility.judged(run).corrections
    assert written["known"] == {"x_imu": 0.2}
    signals["inputs"]["p"] = written["signals"]["p"]
    path.write_text(yaml.safe_dump(content))
    [flight] = config.read_flights(config.load(path))
    np.testing.assert_allclose(flight.inputs["p"], true[1][:, 0], atol=0.02)
