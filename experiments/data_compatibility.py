"""Coverage of the intervals of a compatibility analysis, from sensors with injected errors.

    .venv/bin/python experiments/data_compatibility.py [--runs N | --quick]

A flight about hover with known angles and accelerations is logged by sensors with errors: gyro bias
and scale, accelerometer bias and scale, a lever arm, an IMU that is early. Errors and noise are
drawn anew in each run. The table shows for each error the share of runs whose 95 % interval
contains it, the mean error in sds, and its rms. With `--results FILE` each run is stored as it
ends, and a later call with the same options continues.
"""

import argparse
import contextlib
import json
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from heli_jax.config.kinematics import errors_of, free_noise, sharpened, substeps_of  # noqa: E402
from heli_jax.dynamics import kinematics  # noqa: E402
from heli_jax.dynamics.model import Model  # noqa: E402
from heli_jax.flights.flight import Flight  # noqa: E402
from heli_jax.identification.fit import fit  # noqa: E402
from heli_jax.identification.problem import Nuisance, Problem  # noqa: E402

G = np.array([0.0, 0.0, 9.80665])
SIZES = {"b": 0.02, "lambda": 0.03, "ba": 0.2, "la": 0.02, "arm": 0.1, "delay": 0.02}


class Motion:
    """A flight whose angles and accelerations are sums of sines.

    Rates are central differences of the rotation matrix, so that no formula of the models is used.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.frequency = rng.uniform(0.1, 0.9, (3, 5)) * 2 * np.pi
        self.phase = rng.uniform(0, 2 * np.pi, (3, 5))
        self.amplitude = np.array([0.2, 0.2, 0.5])[:, None] * np.sqrt(2.0 / 5.0)
        self.push_frequency = rng.uniform(0.1, 0.6, (3, 4)) * 2 * np.pi
        self.push_phase = rng.uniform(0, 2 * np.pi, (3, 4))
        self.push = np.array([1.2, 1.2, 1.5])[:, None] / 2.0

    def angles(self, t: np.ndarray) -> np.ndarray:
        """Return phi, theta, psi (k, 3) [rad]."""
        argument = self.frequency * t[:, None, None] + self.phase
        return np.sum(self.amplitude * np.cos(argument), axis=2)

    def attitude(self, t: np.ndarray) -> np.ndarray:
        """Return rotation matrices from body to ground (k, 3, 3)."""
        cosines, sines = np.cos(self.angles(t)).T, np.sin(self.angles(t)).T
        one, zero = np.ones(t.size), np.zeros(t.size)
        (c, d, e), (s, z, y) = cosines, sines
        roll = np.array([[one, zero, zero], [zero, c, -s], [zero, s, c]])
        pitch = np.array([[d, zero, z], [zero, one, zero], [-z, zero, d]])
        yaw = np.array([[e, -y, zero], [y, e, zero], [zero, zero, one]])
        return np.einsum("ijk,jlk,lmk->kim", yaw, pitch, roll)

    def omega(self, t: np.ndarray, h: float = 1e-4) -> np.ndarray:
        """Return body rates (k, 3) [rad/s], from R' dR/dt, their cross-product matrix."""
        slope = (self.attitude(t + h) - self.attitude(t - h)) / (2 * h)
        W = np.einsum("kji,kjl->kil", self.attitude(t), slope)
        return np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], axis=1)

    def alpha(self, t: np.ndarray, h: float = 1e-3) -> np.ndarray:
        """Return angular accelerations (k, 3) [rad/s^2]."""
        return (self.omega(t + h) - self.omega(t - h)) / (2 * h)

    def _pushes(self, t: np.ndarray, order: int) -> np.ndarray:
        """Return acceleration (0), velocity (1) or position (2) over the ground (k, 3)."""
        angle = self.push_frequency * t[:, None, None] + self.push_phase - order * np.pi / 2
        return np.sum(self.push / self.push_frequency**order * np.cos(angle), axis=2)

    def velocity(self, t: np.ndarray) -> np.ndarray:
        """Return velocity over the ground (k, 3) [m/s]."""
        return self._pushes(t, 1)

    def position(self, t: np.ndarray) -> np.ndarray:
        """Return position (k, 3) [m]."""
        return self._pushes(t, 2)

    def force(self, t: np.ndarray, arm: np.ndarray) -> np.ndarray:
        """Return the specific force at the IMU (k, 3) [m/s^2]."""
        R, w = self.attitude(t), self.omega(t)
        at_reference = np.einsum("kji,kj->ki", R, self._pushes(t, 0) - G)
        return at_reference + np.cross(self.alpha(t), arm) + np.cross(w, np.cross(w, arm))


def draw_errors(rng: np.random.Generator, whole: bool) -> dict[str, float]:
    """Return injected errors by the model's names."""

    def drawn(size: float) -> float:
        return float(size * rng.uniform(-1.5, 1.5))

    errors = {f"b_{n}": drawn(SIZES["b"]) for n in "pqr"}
    errors |= {f"lambda_{n}": drawn(SIZES["lambda"]) for n in "pqr"}
    errors["delay_gyro"] = drawn(SIZES["delay"])
    if whole:
        errors |= {f"b_a{n}": drawn(SIZES["ba"]) for n in "xyz"}
        errors |= {f"lambda_a{n}": drawn(SIZES["la"]) for n in "xyz"}
        errors |= {f"{n}_imu": drawn(SIZES["arm"]) for n in "xyz"}
        errors["delay_accel"] = errors["delay_gyro"]
    return errors


def logged(
    rng: np.random.Generator, errors: dict[str, float], gyro_noise: float, times: np.ndarray
) -> Flight:
    """Return one flight as measured, at equally spaced times (N,) [s]."""
    motion, whole = Motion(rng), "b_ax" in errors
    t, n = times, times.size
    late = t - errors["delay_gyro"]

    def shown(true: np.ndarray, names: tuple[str, ...], noise: float) -> dict[str, np.ndarray]:
        return {
            name: (1 + errors[f"lambda_{name}"]) * true[:, i]
            + errors[f"b_{name}"]
            + noise * rng.standard_normal(n)
            for i, name in enumerate(names)
        }

    inputs = shown(motion.omega(t), ("p", "q", "r"), gyro_noise)
    # Other sensors are late relative to the gyros.
    outputs = {
        name: motion.angles(late)[:, i] + 0.006 * rng.standard_normal(n)
        for i, name in enumerate(("phi", "theta", "psi"))
    }
    if whole:
        arm = np.array([errors[f"{axis}_imu"] for axis in "xyz"])
        inputs |= shown(motion.force(t, arm), ("ax", "ay", "az"), 0.3)
        velocity, position = motion.velocity(late), motion.position(late)
        for i in range(3):
            outputs[kinematics.GROUND[i]] = velocity[:, i] + 0.05 * rng.standard_normal(n)
            outputs["NED"[i]] = position[:, i] + 0.02 * rng.standard_normal(n)
    return Flight(
        dt=float(t[1]), inputs=inputs, outputs=outputs, hold=dict.fromkeys(inputs, "linear")
    )


def compare(
    model: Model, flight: Flight, truth: dict[str, float], method: str
) -> dict[str, tuple[bool, float]]:
    """Return by error: True if its interval contains the truth, and the estimate's error [sd]."""
    params = model.Params()
    noise = free_noise(model, params, (flight,)) if method == "filter-error" else {}
    problem = Problem(
        model,
        params,
        [sharpened(model, flight)],
        {**noise, **errors_of(model, flight.outputs)},
        Nuisance(bias=False, input_offset=False),
        substeps=substeps_of(model, (flight,)),
        method=method,
    )
    found = fit(problem, starts=1)
    return {
        n: (e.lower95 <= truth[n] <= e.upper95, (e.value - truth[n]) / e.sd)
        for n, e in found.estimates.items()
        if n in truth and e.sd is not None and e.lower95 is not None and e.upper95 is not None
    }


def show(table: dict[str, list[tuple[bool, float]]]) -> None:
    print(f"{'error':12} {'holds':>6} {'runs':>5} {'mean/sd':>8} {'rms/sd':>7}")
    for name, rows in table.items():
        z = np.array([r[1] for r in rows])
        held = 100 * np.mean([r[0] for r in rows])
        rms = np.sqrt(np.mean(z**2))
        print(f"{name:12} {held:5.0f}% {len(rows):5d} {z.mean():8.2f} {rms:7.2f}")
    z = np.array([r[1] for rows in table.values() for r in rows])
    held = 100 * np.mean([r[0] for rows in table.values() for r in rows])
    print(f"{'all':12} {held:5.1f}% {z.size:5d} {z.mean():8.2f} {np.sqrt(np.mean(z**2)):7.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, help="(100)")
    parser.add_argument("--quick", action="store_true", help="3 runs, to see that it runs")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--duration", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=100.0, help="of the log [Hz]")
    parser.add_argument("--gyro-noise", type=float, default=0.01, help="sd of a sample [rad/s]")
    parser.add_argument("--angles", action="store_true", help="rates against angles alone")
    parser.add_argument("--method", default="filter-error")
    parser.add_argument("--results", type=Path, help="a line of JSON for each run, gone on with")
    options = parser.parse_args()
    runs = options.runs or (3 if options.quick else 100)
    table: dict[str, list[tuple[bool, float]]] = {}
    results: Path | None = options.results
    for line in results.read_text().splitlines() if results and results.exists() else ():
        for name, row in json.loads(line).items():
            table.setdefault(name, []).append(row)
    done = max(map(len, table.values()), default=0)
    model = kinematics.attitude if options.angles else kinematics.position
    times, began = np.arange(0.0, options.duration, 1 / options.rate), time.perf_counter()
    # An interrupted run shows its results so far.
    with contextlib.suppress(KeyboardInterrupt):
        for run in range(options.first + done, options.first + runs):
            rng = np.random.default_rng(run)
            truth = draw_errors(rng, not options.angles)
            flight = logged(rng, truth, options.gyro_noise, times)
            rows = compare(model, flight, truth, options.method)
            if results:
                with results.open("a") as file:
                    file.write(json.dumps({n: [bool(a), float(b)] for n, (a, b) in rows.items()}))
                    file.write("\n")
            for name, row in rows.items():
                table.setdefault(name, []).append(row)
    print(
        f"{options.method}, {model.name}, gyro noise {options.gyro_noise:g} rad/s, "
        f"{options.duration:g} s at {options.rate:g} Hz; {time.perf_counter() - began:.0f} s"
    )
    show(table)


if __name__ == "__main__":
    main()
