"""The variant `full` as forces and moments on a rigid body, with NumPy and SciPy alone.

Vectors are in body axes (forward, right, down). Every force acts at its position, moments are r x
F, and the body follows Newton's and Euler's equations. States, inputs and vehicles are mappings of
floats.
"""

import numpy as np

from tests.dynamics.whole_helicopter import (
    XCELL,
    air_and_body_rates,
    blade_cyclic,
    body_to_earth,
    euler_to_body,
    induced_velocity,
)

FULL = XCELL | {
    "I_beta": 0.038, "k_beta": 54.0, "K_mu": 1.0, "h_T": 0.08, "K_P": 0.01, "K_I": 0.02,
    "Omega": 157.1,
}  # fmt: skip


def rotor(v, R, c, a, speed, theta0, V2, W, edge):
    """Return thrust, total inflow and torque of a rotor of two blades."""
    half, B, rho = a * c / (np.pi * R), v["B"], v["rho"]
    b = half * B**2 / 2 * R * speed
    T0 = half * B**3 / 3 * (R * speed) ** 2 * theta0 + b * (edge - W)
    vi = induced_velocity(V2, W, T0, b)
    T, inflow = rho * np.pi * R**2 * (T0 - b * vi), W + vi
    lam, mu_theta = inflow / (R * speed), edge / (R * speed)
    lift = B**3 / 3 * theta0 - B**2 / 2 * lam + B**2 / 4 * mu_theta
    sigma = 2 * c / (np.pi * R)
    torque = rho * np.pi * R**5 * speed**2 * (sigma * v["Cd0"] / 8 + a * sigma / 2 * lam * lift)
    return T, inflow, torque


def rates(v, s, u, wind=(0.0, 0.0, 0.0)):
    """Return the derivatives of the 18 states."""
    Om, B = s["Omega"], v["B"]
    air, omega = air_and_body_rates(s, wind)
    p, q, _ = omega
    hub, tail = np.array([-v["lr"], 0, -v["hr"]]), np.array([-v["L_T"], 0, -v["h_T"]])
    # The main rotor in the axes of its tip-path plane; its thrust is along `up`.
    up = np.array([-s["a1"], s["b1"], -1.0])
    there = air + np.cross(omega, hub)
    pitch = blade_cyclic(v, u["x_pitch"], s["beta_pitch"])
    roll = blade_cyclic(v, u["x_roll"], s["beta_roll"])
    edge = there[0] * (pitch - s["a1"]) - there[1] * (roll - s["b1"])
    theta0 = v["K_theta0"] * u["x_collective"]
    T, inflow, Q = rotor(
        v, v["R"], v["c"], v["a"], Om, theta0, there[0] ** 2 + there[1] ** 2, there @ up, edge
    )
    # The tail rotor's thrust is along -y.
    tail_speed, at_tail = v["K_Omega"] * Om, air + np.cross(omega, tail)
    T_T, _, Q_T = rotor(
        v, v["R_T"], v["c_T"], v["a_T"], tail_speed, v["K_theta0T"] * u["x_yaw"],
        at_tail[0] ** 2 + at_tail[2] ** 2, -at_tail[1], 0.0,
    )  # fmt: skip
    drag = -v["rho"] / 2 * np.linalg.norm(air) * np.array([v["Sx"], v["Sy"], v["Sz"]]) * air
    forces = [(hub, T * up), (tail, np.array([0.0, -T_T, 0.0])), (np.zeros(3), drag)]
    # The motor, by a governor with limits.
    error = u["x_throttle"] * v["Omega"] - Om
    free = v["K_P"] * error + s["governor"]
    throttle = min(max(free, 0.0), 1.0)
    d = {k: s["d" + k] for k in ("x", "y", "z", "phi", "theta", "psi")}
    d["governor"] = v["K_I"] * (error + (throttle - free) / v["K_P"])
    d["Omega"] = v["K_throttle"] * throttle - (Q + v["K_Omega"] * Q_T) / v["Ir"]
    motor = v["Ir"] * v["K_throttle"] * throttle - v["K_Omega"] * Q_T
    moment = v["k_beta"] * np.array([s["b1"], s["a1"], 0.0]) + [0.0, 0.0, motor]
    moment += sum(np.cross(r, F) for r, F in forces)
    force = body_to_earth(s) @ sum(F for _, F in forces)
    d["dx"], d["dy"], d["dz"] = force / v["m"] - [0.0, 0.0, v["g"]]
    inertia = np.array([v["Ixx"] + v["Ixx_added"], v["Iyy"] + v["Iyy_added"], v["Izz"]])
    domega = (moment - np.cross(omega, inertia * omega)) / inertia
    E, dE = euler_to_body(s)
    turning = [s["dphi"], s["dtheta"], s["dpsi"]]
    d["dphi"], d["dtheta"], d["dpsi"] = np.linalg.solve(E, domega - dE @ turning)
    # Tip-path plane and bar.
    gamma = v["rho"] * v["a"] * v["c"] * v["R"] ** 4 / v["I_beta"]
    tau = 16 / (gamma * Om * B**4)
    lam, RO = inflow / (v["R"] * Om), v["R"] * Om
    back = 2 * v["K_mu"] * (4 / 3 * B**3 * theta0 - B**2 * lam) / B**4
    turn = v["k_beta"] / (2 * v["I_beta"] * Om)
    d["a1"] = (pitch + back * there[0] / RO - s["a1"]) / tau - q + turn * s["b1"]
    d["b1"] = (roll - back * there[1] / RO - s["b1"]) / tau - p - turn * s["a1"]
    K = v["rho"] * v["a"] * v["c"] * (v["R2"] ** 4 - v["R1"] ** 4) / (4 * v["If"])
    for axis, rate in (("roll", p), ("pitch", q)):
        tilt = u["x_" + axis] / v["L5"] - s["beta_" + axis]
        d["beta_" + axis] = tilt * K * Om / 2 - rate
    return {k: float(x) for k, x in d.items()}
