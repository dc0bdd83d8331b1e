"""White-noise test of signals, on records with known noise."""

from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from heli_jax import cli, yaml_file
from heli_jax.numerics.white_noise import (
    has_coloured_noise,
    noise_guess,
    rises_when_slower,
    without_noise,
)

T = np.arange(3000) * 0.01
STICK = 0.1 * np.sign(np.sin(2.0 * T)) * (np.sin(0.31 * T) > -0.5)
RATE = np.convolve(STICK, 0.05 * np.exp(-T / 0.2))[: T.size]
ANGLE = np.cumsum(RATE) * 0.01


def angles(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a gyro rate, an angle from a separate sensor, and the integral of the gyro."""
    rng = np.random.default_rng(seed)
    # The gyro is read ten times as often as it is logged.
    fast = 0.03 * rng.standard_normal((T.size, 10))
    gyro = RATE + fast[:, -1]
    return gyro, ANGLE + 0.003 * rng.standard_normal(T.size), ANGLE + np.cumsum(fast.mean(1)) * 0.01


@pytest.mark.parametrize("seed", range(5))
def test_an_integrated_rate_wanders_and_white_noise_does_not(seed: int) -> None:
    gyro, sensor, integrated = angles(seed)
    assert has_coloured_noise(integrated)
    assert not has_coloured_noise(gyro)
    assert not has_coloured_noise(sensor)
    # Lost samples and a rounding to 0.001 degrees change nothing.
    lost = np.random.default_rng(seed).random(T.size) < 0.02
    assert has_coloured_noise(
        np.where(lost, np.nan, np.radians(np.round(np.degrees(integrated), 3)))
    )
    # A sensor half as fast repeats its values.
    assert not has_coloured_noise(np.repeat(sensor[::2], 2))
    # A few samples give no result.
    assert not has_coloured_noise(integrated[:300])


def test_a_smoothed_signal_has_no_noise_of_a_sensor() -> None:
    gyro, _, _ = angles(0)
    smooth = np.sin(T) + 0.3 * np.sin(3.1 * T)
    assert without_noise(smooth)
    assert has_coloured_noise(smooth)
    assert not without_noise(gyro)
    assert noise_guess(gyro) == pytest.approx(0.03, rel=0.1)
    assert not without_noise(np.zeros(10))


def _new(folder: Path, phi: np.ndarray, p: np.ndarray) -> tuple[dict, str]:
    rows = "\n".join(
        f"{t:.2f},{u:.3f},{a:.6f},{b:.5f}" for t, u, a, b in zip(T, STICK, phi, p, strict=True)
    )
    (folder / "run.csv").write_text(f"t,lat,roll_rad,gyro_x_rad_s\n{rows}\n")
    out = folder / "run.yaml"
    out.unlink(missing_ok=True)
    assert cli.main(["new", str(folder / "run.csv"), "--out", str(out)]) == 0
    return yaml_file.read_mapping(out), out.read_text()


def test_new_leaves_out_an_integrated_angle_and_takes_a_sensors(tmp_path: Path) -> None:
    gyro, sensor, integrated = angles(2)
    made, text = _new(tmp_path, integrated, gyro)
    assert set(made["flights"][0]["signals"]["outputs"]) == {"p"}
    assert "without phi" in text
    assert "# phi: {signal: " in text
    assert "Not found by name" not in text
    made, text = _new(tmp_path, sensor, gyro)
    assert set(made["flights"][0]["signals"]["outputs"]) == {"phi", "p"}
    assert made["fit"]["method"] == "filter-error"


def test_new_takes_output_error_for_a_log_without_noise(tmp_path: Path) -> None:
    smooth = np.sin(T) + 0.3 * np.sin(3.1 * T)
    made, text = _new(tmp_path, smooth, np.cos(T) + 0.93 * np.cos(3.1 * T))
    assert made["fit"]["method"] == "output-error"
    assert "disturbance" not in made
    assert "smoothed or" in text


@pytest.mark.parametrize("seed", range(3))
def test_noise_that_went_through_a_low_pass_shows_below_white_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    white, before = rng.normal(size=(2, 3000))
    a = np.exp(-2 * np.pi * 10.0 * 0.01)
    filtered = np.asarray(scipy.signal.lfilter([np.sqrt(1 - a * a)], [1, -a], before))
    assert rises_when_slower(filtered + white, 3)
    assert not has_coloured_noise(filtered + white)
    lost = rng.random(3000) < 0.2
    assert rises_when_slower(np.where(lost, np.nan, filtered), 3)
    assert not rises_when_slower(np.where(lost, np.nan, white), 3)
    assert not rises_when_slower(white, 3)
    assert not rises_when_slower(filtered[:300], 3)
