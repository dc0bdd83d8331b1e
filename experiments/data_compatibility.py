"""How often the intervals of a compatibility analysis hold: sensors with injected errors.

    python experiments/data_compatibility.py --runs 100

A flight about hover, from a quaternion integrated in NumPy, is logged by sensors with errors: gyro
bias and scale, accelerometer bias and scale, a lever arm, an IMU that is early against the rest.
The errors and all noise are drawn anew in each run. For each error: the share of runs whose 95 %
interval holds it, the mean error in sds, and the rms of that error.
"""

import argparse
import sys
import time

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from heli_jax.config.kinematics import errors_of, noise_of  # noqa: E402
from heli_jax.dynamics import kinematics  # noqa: E402
from heli_jax.flights.flight import Flight  # noqa: E402
from heli_jax.identification.fit import fit  # noqa: E402
from heli_jax.identification.problem import Nuisance, Problem  # noqa: E402
from heli_jax.simulation.simulate import substeps_for  # noqa: E402

G = np.array([0.0, 0.0, 9.80665])
RATE = 50.0
SIZES = {"b": 0.02, "lambda": 0.03, "ba": 0.2, "la": 0.02, "arm": 0.1, "delay": 0.02}


def rotation(q: np.ndarray) -> np.ndarray:
    """Body to ground (k, 3, 3) of quaternions w, x, y, z (k, 4)."""
    w, x, y, z = q.T
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)


class Motion:
    """A flight of known rates and accelerations: angles by Runge-Kutta, the rest in closed form."""

    def __init__(self, rng: np.random.Generator, duration: float) -> None:
        # Sums of sines of zero mean angle, so that the machine stays about hover.
        self.frequency = rng.uniform(0.15, 1.2, (3, 5)) * 2 * np.pi
        self.phase = rng.uniform(0, 2 * np.pi, (3, 5))
        size = np.array([0.22, 0.22, 0.5])[:, None]
        self.amplitude = size * self.frequency / np.sqrt(5.0)
        self.push_frequency = rng.uniform(0.1, 0.6, (3, 4)) * 2 * np.pi
        self.push_phase = rng.uniform(0, 2 * np.pi, (3, 4))
        self.push = np.array([1.2, 1.2, 1.5])[:, None] / 2.0
        # From before the first sample on, since sensors may be late.
        self.step, self.begin = 1e-3, -0.5
        times = self.begin + self.step * np.arange(round((duration + 1.0) / self.step))
        self.times, self.quaternions = times, self._integrate(times)

    def omega(self, t: np.ndarray) -> np.ndarray:
        """(k, 3) [rad/s]"""
        angle = self.frequency * t[:, None, None] + self.phase
        return np.sum(self.amplitude * np.cos(angle), axis=2)

    def alpha(self, t: np.ndarray) -> np.ndarray:
        """(k, 3) [rad/s^2]"""
        angle = self.frequency * t[:, None, None] + self.phase
        return -np.sum(self.amplitude * self.frequency * np.sin(angle), axis=2)

    def _pushes(self, t: np.ndarray, order: int) -> np.ndarray:
        """Acceleration (0), velocity (1), position (2) over the ground (k, 3)."""
        angle = self.push_frequency * t[:, None, None] + self.push_phase - order * np.pi / 2
        return np.sum(self.push / self.push_frequency**order * np.cos(angle), axis=2)

    def _integrate(self, times: np.ndarray) -> np.ndarray:
        def rate(q: np.ndarray, w: np.ndarray) -> np.ndarray:
            return 0.5 * np.array(
                [
                    -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
                    q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
                    q[0] * w[1] - q[1] * w[2] + q[3] * w[0],
                    q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
                ]
            )

        h, q = self.step, np.array([1.0, 0.0, 0.0, 0.0])
        first, middle, last = (self.omega(times + s * h) for s in (0.0, 0.5, 1.0))
        out = np.empty((times.size, 4))
        for k in range(times.size):
            out[k] = q
            k1 = rate(q, first[k])
            k2 = rate(q + 0.5 * h * k1, middle[k])
            k3 = rate(q + 0.5 * h * k2, middle[k])
            k4 = rate(q + h * k3, last[k])
            q = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            q /= np.linalg.norm(q)
        return out

    def attitude(self, t: np.ndarray) -> np.ndarray:
        """Body to ground (k, 3, 3); between steps of 1 ms by a straight line."""
        q = np.stack([np.interp(t, self.times, self.quaternions[:, i]) for i in range(4)], axis=1)
        return rotation(q / np.linalg.norm(q, axis=1)[:, None])

    def angles(self, t: np.ndarray) -> np.ndarray:
        """phi, theta, psi (k, 3) [rad]."""
        R = self.attitude(t)
        phi, psi = np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
        return np.stack([phi, -np.arcsin(R[:, 2, 0]), np.unwrap(psi)], axis=1)

    def velocity(self, t: np.ndarray) -> np.ndarray:
        """(k, 3) over the ground [m/s]."""
        return self._pushes(t, 1)

    def position(self, t: np.ndarray) -> np.ndarray:
        """(k, 3) [m]."""
        return self._pushes(t, 2)

    def force(self, t: np.ndarray, arm: np.ndarray) -> np.ndarray:
        """Specific force (k, 3) at the IMU [m/s^2]."""
        R, w = self.attitude(t), self.omega(t)
        at_reference = np.einsum("kji,kj->ki", R, self._pushes(t, 0) - G)
        return at_reference + np.cross(self.alpha(t), arm) + np.cross(w, np.cross(w, arm))


def draw_errors(rng: np.random.Generator, whole: bool) -> dict[str, float]:
    """Injected errors by the model's names."""

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
    rng: np.random.Generator, errors: dict[str, float], gyro_noise: float, duration: float
) -> Flight:
    """One flight as the sensors have it."""
    motion, whole = Motion(rng, duration), "b_ax" in errors
    t = np.arange(round(duration * RATE)) / RATE
    late, n = t - errors["delay_gyro"], t.size

    def shown(true: np.ndarray, names: tuple[str, ...], noise: float) -> dict[str, np.ndarray]:
        return {
            name: (1 + errors[f"lambda_{name}"]) * true[:, i]
            + errors[f"b_{name}"]
            + noise * rng.standard_normal(n)
            for i, name in enumerate(names)
        }

    inputs = shown(motion.omega(t), ("p", "q", "r"), gyro_noise)
    # Late outputs: what the gyros show now, the others show later.
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
    return Flight(dt=1 / RATE, inputs=inputs, outputs=outputs, hold=dict.fromkeys(inputs, "linear"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--duration", type=float, default=40.0)
    parser.add_argument("--gyro-noise", type=float, default=0.01, help="sd of a sample [rad/s]")
    parser.add_argument("--angles", action="store_true", help="rates against angles alone")
    parser.add_argument("--method", default="filter-error")
    options = parser.parse_args()
    table: dict[str, list[tuple[bool, float]]] = {}
    model = kinematics.attitude if options.angles else kinematics.position
    for run in range(options.first, options.first + options.runs):
        began = time.perf_counter()
        rng = np.random.default_rng(run)
        truth = draw_errors(rng, not options.angles)
        flight = logged(rng, truth, options.gyro_noise, options.duration)
        noise = noise_of(model, (flight,)) if options.method == "filter-error" else {}
        problem = Problem(
            model,
            model.Params(**noise),
            [flight],
            errors_of(model, flight.outputs),
            Nuisance(bias=False, input_offset=False),
            substeps=substeps_for(flight.dt),
            method=options.method,
        )
        found = fit(problem, starts=1)
        for name, estimate in found.estimates.items():
            if estimate.sd is None:
                print(f"run {run}: {name} not determined", file=sys.stderr)
                continue
            holds = estimate.lower95 <= truth[name] <= estimate.upper95
            table.setdefault(name, []).append((holds, (estimate.value - truth[name]) / estimate.sd))
        print(
            f"run {run}: {found.status}, {time.perf_counter() - began:.1f} s, coloured "
            f"{found.coloured}",
            file=sys.stderr,
            flush=True,
        )
    print(f"{options.method}, gyro noise {options.gyro_noise:g} rad/s, {options.duration:g} s")
    print(f"{'error':12} {'holds':>6} {'runs':>5} {'mean/sd':>8} {'rms/sd':>7}")
    for name, rows in table.items():
        z = np.array([r[1] for r in rows])
        held = 100 * np.mean([r[0] for r in rows])
        rms = np.sqrt(np.mean(z**2))
        print(f"{name:12} {held:5.0f}% {len(rows):5d} {z.mean():8.2f} {rms:7.2f}")


if __name__ == "__main__":
    main()
