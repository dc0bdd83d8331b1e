"""Fits of a multi-rate log with known truth, made like an autopilot's log.

    .venv/bin/python experiments/multirate_log.py [RUNS]

A helicopter's lateral motion in hover (flapping, roll, drift) is simulated in steps of 0.25 ms with
SciPy, and logged as an autopilot does. The gyro is at 400 Hz, after a digital low-pass of 90 Hz,
and 3 ms late. Attitude and stick are at 50 Hz; GPS velocity is at 5 Hz and 120 ms late. Stamps are
off by a fifth of a step, and a fiftieth of the samples is lost. Each log is fitted with and without
filter and delays in the measurement model; the filter is read from the log's parameters. The table
has the mean error, its chance deviation from zero, and the scatter of the estimates, in units of
the stated sd. It also has the number of 95 % intervals with the truth.
"""

import math
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
import scipy.signal
import yaml

from heli_jax import config as configuration
from heli_jax import fit, load_config

jax.config.update("jax_enable_x64", True)

TRUTH = {"Lb": 160.0, "tau_f": 0.046, "Blat": 0.14, "Yv": -0.4}
STARTS = {"Lb": 120.0, "tau_f": 0.07, "Blat": 0.2, "Yv": -0.2}
G, LENGTH, STEP = 9.81, 20.0, 0.25e-3
GYRO_HZ, CUTOFF, GYRO_LATE = 400.0, 90.0, 0.003
ATTITUDE_HZ, GPS_HZ, GPS_LATE, STICK_HZ = 50.0, 5.0, 0.12, 50.0
JITTER, LOST, RATE = 0.2, 0.02, 200.0
SD = {"gyro": 0.2, "phi": 0.004, "v": 0.05}
"""Noise sd: gyro [rad/s] before its filter, white at 4 kHz; angle [rad]; GPS [m/s]."""

MODEL = f"""
name: lateral
states:
  v: {{unit: m/s, meaning: speed to the right}}
  phi: {{unit: rad, meaning: roll angle}}
  p: {{unit: rad/s, meaning: roll rate}}
  b: {{unit: rad, meaning: lateral flapping}}
inputs:
  lat: {{unit: "1", meaning: lateral cyclic}}
outputs:
  v: m/s
  phi: rad
  p: rad/s
parameters:
  Lb: {{value: 120.0, unit: 1/s^2, positive: true}}
  tau_f: {{value: 0.07, unit: s, positive: true}}
  Blat: {{value: 0.2, unit: rad}}
  Yv: {{value: -0.2, unit: 1/s}}
A:
  v: {{v: Yv, phi: {G}}}
  phi: {{p: 1}}
  p: {{b: Lb}}
  b: {{p: -1, b: -1/tau_f}}
B:
  b: {{lat: Blat/tau_f}}
"""


def stick(times: np.ndarray) -> np.ndarray:
    """Return the pilot's lateral stick (N,), 0.1 to 2.5 Hz, at any times [s]."""
    hz = np.array([0.15, 0.35, 0.6, 0.95, 1.4, 1.9, 2.5])
    phases = np.array([0.3, 2.1, 4.4, 1.2, 5.5, 3.3, 0.9])
    waves = np.sin(2 * np.pi * np.outer(np.asarray(times), hz) + phases)
    return 0.35 * np.sin(np.pi * np.clip(times / LENGTH, 0, 1)) ** 0.5 * waves.mean(axis=1)


def motion() -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) and v, phi, p (N, 3) of the true flight."""
    Lb, tau, Blat, Yv = TRUTH.values()
    A = np.array([[Yv, G, 0, 0], [0, 0, 1, 0], [0, 0, 0, Lb], [0, 0, -1, -1 / tau]])
    B = np.array([[0], [0], [0], [Blat / tau]])
    times = np.arange(round(LENGTH / STEP)) * STEP
    system = scipy.signal.StateSpace(A, B, np.eye(4)[:3], np.zeros((3, 1)))
    return times, scipy.signal.lsim(system, stick(times), times)[1]


def stamps(rate: float, rng: np.random.Generator) -> np.ndarray:
    """Return the log times of a sensor [s], with jitter and lost samples."""
    n = int((LENGTH - 0.5) * rate)
    times = 0.25 + (np.arange(n) + rng.uniform(-JITTER, JITTER, n)) / rate
    kept = rng.random(n) > LOST
    kept[[0, -1]] = True
    return times[kept]


def log_text(times: np.ndarray, truth: np.ndarray, rng: np.random.Generator) -> str:
    """Return the flight as a DataFlash log in text.

    Args:
        times: times of the true flight (N,) [s].
        truth: v, phi, p (N, 3).
        rng: generator for noise, jitter and losses.
    """
    # Bilinear and prewarped, as in firmware.
    sos = scipy.signal.butter(2, CUTOFF, fs=1 / STEP, output="sos")
    noisy = truth[:, 2] + SD["gyro"] * rng.standard_normal(times.size)
    gyro = np.asarray(scipy.signal.sosfilt(sos, noisy))

    def taken(signal: np.ndarray, at: np.ndarray, late: float, sd: float = 0.0) -> np.ndarray:
        """Return a signal's samples (M,) at stamps, with delay and noise.

        Args:
            signal: true values (N,).
            at: stamps (M,) [s].
            late: delay [s].
            sd: standard deviation of the noise.
        """
        return np.interp(at - late, times, signal) + sd * rng.standard_normal(at.size)

    clocks = {n: stamps(hz, rng) for n, hz in zip(FORMATS, RATES, strict=True)}
    values = {
        "IMU": taken(gyro, clocks["IMU"], GYRO_LATE),
        "ATT": np.degrees(taken(truth[:, 1], clocks["ATT"], 0.0, SD["phi"])),
        "GPS": taken(truth[:, 0], clocks["GPS"], GPS_LATE, SD["v"]),
        "RCIN": stick(clocks["RCIN"]),
    }
    lines = [f"FMT, {130 + i}, 19, {n}, Qd, TimeUS,{c}" for i, (n, c) in enumerate(FORMATS.items())]
    lines += ["FMT, 140, 31, PARM, QNf, TimeUS,Name,Value", "PARM, 0, INS_GYRO_FILTER, 90.0"]
    rows = [
        (t, f"{n}, {round(1e6 * t)}, {x:.9g}")
        for n in FORMATS
        for t, x in zip(clocks[n], values[n], strict=True)
    ]
    return "\n".join([*lines, *(text for _, text in sorted(rows))]) + "\n"


FORMATS = {"IMU": "GyrX", "ATT": "Roll", "GPS": "VY", "RCIN": "C1"}
RATES = (GYRO_HZ, ATTITUDE_HZ, GPS_HZ, STICK_HZ)


def config(measured: bool) -> dict:
    """Return the configuration of a fit, with or without filter and delays."""
    gyro, gps = {"signal": "IMU.GyrX", "unit": "rad/s"}, {"signal": "GPS.VY", "unit": "m/s"}
    if measured:
        gyro |= {"filter": "from log", "delay": GYRO_LATE}
        gps |= {"delay": GPS_LATE}
    outputs = {"p": gyro, "phi": {"signal": "ATT.Roll", "unit": "deg"}, "v": gps}
    inputs = {"lat": {"signal": "RCIN.C1", "unit": "1", "hold": "linear"}}
    return {
        "model": {"linear": "lateral.yaml"},
        "flights": [
            {
                "log": "flight.log",
                "rate": RATE,
                "window": [0.5, LENGTH - 1.0],
                "signals": {"inputs": inputs, "outputs": outputs},
            }
        ],
        "fit": {"free": {n: {"start": x} for n, x in STARTS.items()}},
    }


def estimates(folder: Path, measured: bool) -> dict[str, tuple[float, float]]:
    """Return each parameter's estimate and sd from the log in a folder."""
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(config(measured)))
    found = fit(configuration.problem(load_config(path)))
    # None if not identifiable, which becomes nan in the table.
    return {n: (e.value, math.nan if e.sd is None else e.sd) for n, e in found.estimates.items()}


def main(runs: int) -> None:
    """Print the table."""
    times, truth = motion()
    errors: dict[bool, list[list[float]]] = {True: [], False: []}
    sds: dict[bool, list[list[float]]] = {True: [], False: []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "lateral.yaml").write_text(MODEL)
        for seed in range(runs):
            text = log_text(times, truth, np.random.default_rng(seed))
            (folder / "flight.log").write_text(text)
            for measured in (True, False):
                found = estimates(folder, measured)
                errors[measured].append([found[n][0] - x for n, x in TRUTH.items()])
                sds[measured].append([found[n][1] for n in TRUTH])
            print(f"{seed + 1} of {runs}", end="\r", file=sys.stderr)
    print(f"{runs} runs")
    for measured, title in ((True, "filter and delays modelled"), (False, "ignored")):
        print(
            f"\n{title}\n{'':8}{'error/sd':>12}{'+- by chance':>14}{'scatter/sd':>12}{'inside':>9}"
        )
        e, sd = np.array(errors[measured]), np.array(sds[measured])
        for i, n in enumerate(TRUTH):
            usual = float(np.mean(sd[:, i]))
            mean, scatter = float(np.mean(e[:, i])), float(np.std(e[:, i], ddof=1))
            inside = int(np.sum(np.abs(e[:, i]) < 1.96 * sd[:, i]))
            chance = scatter / usual / math.sqrt(runs)
            print(
                f"{n:8}{mean / usual:12.2f}{chance:14.2f}{scatter / usual:12.2f}{inside:5d}/{runs}"
            )


if __name__ == "__main__":
    from script import Size, asked

    main(asked(__doc__, "half an hour", Size("runs", 100, 2, "logs")).runs)
