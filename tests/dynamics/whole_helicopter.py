"""Eqs 2-20 of the paper and their corrected form, with NumPy and SciPy alone.

States, inputs and vehicles are mappings of floats. Earth axes x, y, z have z up; body axes are
forward, right, down. phi, theta, psi are yaw-pitch-roll Euler angles, dphi, dtheta, dpsi their
derivatives. Run as a program, it prints the numbers of hover.
"""

import numpy as np
from scipy.optimize import brentq, root

XCELL = {
    "m": 8.845,
    "Ixx": 0.296,
    "Iyy": 0.436,
    "Izz": 0.625,
    "Ixx_added": 0.0,
    "Iyy_added": 0.0,
    "R": 0.686,
    "c": 0.0603,
    "a": 6.0,
    "Cd0": 0.01,
    "hr": 0.277,
    "lr": 0.005,
    "R_T": 0.165,
    "c_T": 0.0302,
    "a_T": 3.0,
    "L_T": 1.054,
    "K_Omega": 4.6,
    "Ir": 0.1148,
    "If": 0.0104,
    "L1": 0.020,
    "L2": 0.020,
    "L3": 0.020,
    "L4": 0.012,
    "L5": 0.020,
    "R1": 0.231,
    "R2": 0.312,
    "K_theta0": 0.302,
    "K_Tm": 7.425,
    "K_throttle": 64.68,
    "K_theta0T": 0.178,
    "Sx": 0.1,
    "Sy": 0.22,
    "Sz": 0.15,
    "cyclic_moment": 0.5,
    "B": 0.97,
    "rho": 1.225,
    "g": 9.80665,
}
_BODY = ("x", "y", "z", "phi", "theta", "psi", "dx", "dy", "dz", "dphi", "dtheta", "dpsi")
STATES = {
    "paper": (*_BODY, "beta_roll", "dbeta_roll", "beta_pitch", "dbeta_pitch", "Omega"),
    "consistent": (*_BODY, "beta_roll", "beta_pitch", "Omega"),
}
INPUTS = ("x_roll", "x_pitch", "x_yaw", "x_throttle")


def flow_through(vi, V2, W):
    """Return the flow through a rotor [m/s], as in `heli_jax.dynamics.aerodynamics`, for vi > 0."""
    q = max(0.0, (-W - 0.5 * vi) * (2.2 * vi + W))
    return np.sqrt(V2 + (W + vi) ** 2 + 0.37 * q**2 / (vi**2 + 5.8 * V2))


def induced_velocity(V2, W, T0, b):
    """Return the root of 2 v s(v) = T0 - b v; T0 and b are a thrust's over rho pi R^2."""
    if T0 < 0:
        return -induced_velocity(V2, -W, -T0, b)
    return brentq(
        lambda v: 2 * v * flow_through(v, V2, W) + b * v - T0, 1e-12, T0 / b, xtol=1e-15, rtol=1e-15
    )


def by_thrust(thrust, inplane, axial, rho, R):
    """Return the same from the thrust [N] as a linearly falling function of vi."""
    area = rho * np.pi * R**2
    slope = (thrust(0.0) - thrust(1.0)) / area
    return induced_velocity(inplane**2, axial, thrust(0.0) / area, slope)


def rotor(v, Omega, x_throttle, inplane, nu, tilt):
    """Return T [N], vi [m/s], lam and drag torque [N m] (eqs 10, 13); `tilt` is mu times cyclic."""
    R, B, rho, a = v["R"], v["B"], v["rho"], v["a"]
    sigma = 2 * v["c"] / (np.pi * R)
    th0 = v["K_theta0"] * x_throttle  # (18)
    scale = rho * np.pi * R**4 * Omega**2

    def thrust(vi):
        lam = -nu + vi / (R * Omega)
        return scale * a * sigma / 2 * (B**3 / 3 * th0 - B**2 / 2 * lam + B**2 / 2 * tilt)

    vi = by_thrust(thrust, inplane, -nu * R * Omega, rho, R)
    lam = -nu + vi / (R * Omega)
    induced = lam * (B**3 / 3 * th0 - B**2 / 2 * lam + B**2 / 4 * tilt)
    torque = scale * R * (sigma * v["Cd0"] / 8 + a * sigma / 2 * induced)
    return {"T": thrust(vi), "vi": vi, "lam": lam, "torque": torque}


def blade_cyclic(v, x_cyc, beta):
    """Return theta_cyc [rad] (eq. 11)."""
    return (v["L3"] * x_cyc + v["L2"] * v["L4"] * beta) / ((v["L2"] + v["L3"]) * v["L1"])


def paper_rotor(v, s, u):
    """Return T, vi, lam and torque, with eqs 8 and 9 as printed."""
    sin, cos = np.sin, np.cos
    phi, theta, hr, RO = s["phi"], s["theta"], v["hr"], v["R"] * s["Omega"]
    forward = s["dx"] - hr * s["dtheta"]
    upward = s["dz"] - v["lr"] * s["dtheta"]
    mu = forward * cos(theta) + (s["dy"] + hr * s["dphi"]) * cos(phi) + upward * sin(theta)
    nu = forward * sin(theta) + (s["dy"] - hr * s["dphi"]) * sin(phi) - upward * cos(theta)
    tilt = mu / RO * (u["x_roll"] + u["x_pitch"]) / v["L1"]
    return rotor(v, s["Omega"], u["x_throttle"], mu, nu / RO, tilt)


def paper_rates(v, s, u):
    """Return the derivatives of the 17 states, eqs 2-20 as printed, without the drag D_F."""
    sin, cos = np.sin, np.cos
    phi, theta, psi, Om, m, rho = s["phi"], s["theta"], s["psi"], s["Omega"], v["m"], v["rho"]
    got = paper_rotor(v, s, u)
    T = got["T"]
    d = {k: s["d" + k] for k in ("x", "y", "z", "phi", "theta", "psi", "beta_roll", "beta_pitch")}
    d["Omega"] = v["K_throttle"] * u["x_throttle"] - got["torque"] / v["Ir"]  # (10)
    d["dx"] = -cos(psi) * T * sin(theta) / m  # (2)
    d["dy"] = cos(psi) * T * sin(phi) / m  # (3)
    d["dz"] = cos(phi) * T * cos(theta) / m - v["g"]  # (4)
    M = {}
    for axis, omega in (("roll", s["dphi"]), ("pitch", s["dtheta"])):
        x, beta, dbeta = u["x_" + axis], s["beta_" + axis], s["dbeta_" + axis]
        # (12)
        lift = rho * Om**2 * v["a"] * v["c"] / 8 * (v["R2"] ** 4 - v["R1"] ** 4)
        d["dbeta_" + axis] = lift * (x / v["L5"] - (dbeta + omega) / Om) / v["If"] - Om**2 * beta
        # (14), (15)
        gain = v["cyclic_moment"] * rho * Om**2 * v["a"] * v["c"] * v["R"] ** 4
        M[axis] = gain * blade_cyclic(v, x, beta)
    d["dphi"] = M["roll"] / (v["Ixx"] + v["Ixx_added"])  # (5)
    d["dtheta"] = (M["pitch"] - T * v["lr"]) / (v["Iyy"] + v["Iyy_added"])  # (6)
    # (16), (17), (20)
    sigma_T = 2 * v["c_T"] / (np.pi * v["R_T"])
    T_T = rho * np.pi / 2 * v["R_T"] ** 4 * (v["K_Omega"] * Om) ** 2 * v["a_T"] * sigma_T
    M_psi = T_T * v["B"] ** 3 / 3 * v["K_theta0T"] * u["x_yaw"] * v["L_T"]
    T_m = v["K_Tm"] * u["x_throttle"]  # (19)
    d["dpsi"] = (M_psi + T_m - v["Ir"] * d["Omega"]) / v["Izz"]  # (7)
    return {k: float(x) for k, x in d.items()}


def body_to_earth(s):
    """Return the rotation from forward, right, down to x, y, z up."""
    (sf, st, sp), (cf, ct, cp) = (f([s["phi"], s["theta"], s["psi"]]) for f in (np.sin, np.cos))
    yaw = np.array([[cp, -sp, 0.0], [sp, cp, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[ct, 0.0, st], [0.0, 1.0, 0.0], [-st, 0.0, ct]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cf, -sf], [0.0, sf, cf]])
    return np.diag([1.0, 1.0, -1.0]) @ yaw @ pitch @ roll


def euler_to_body(s):
    """Return E with (p, q, r) = E (dphi, dtheta, dpsi), and dE/dt."""
    (sf, st), (cf, ct) = (f([s["phi"], s["theta"]]) for f in (np.sin, np.cos))
    df, dt = s["dphi"], s["dtheta"]
    E = np.array([[1.0, 0.0, -st], [0.0, cf, sf * ct], [0.0, -sf, cf * ct]])
    dE = np.array(
        [
            [0.0, 0.0, -ct * dt],
            [0.0, -sf * df, cf * ct * df - sf * st * dt],
            [0.0, -cf * df, -sf * ct * df - cf * st * dt],
        ]
    )
    return E, dE


def air_and_body_rates(s, wind):
    """Return the airspeed vector of the centre of gravity and (p, q, r), both in body axes."""
    velocity = np.array([s["dx"], s["dy"], s["dz"]]) - np.asarray(wind)
    E, _ = euler_to_body(s)
    return body_to_earth(s).T @ velocity, E @ [s["dphi"], s["dtheta"], s["dpsi"]]


def consistent_rotor(v, s, u, wind=(0.0, 0.0, 0.0)):
    """Return T, vi, lam and torque of the rotor at the hub's airspeed."""
    air, omega = air_and_body_rates(s, wind)
    u_h, v_h, w_h = air + np.cross(omega, [-v["lr"], 0.0, -v["hr"]])
    RO = v["R"] * s["Omega"]
    roll = blade_cyclic(v, u["x_roll"], s["beta_roll"])
    pitch = blade_cyclic(v, u["x_pitch"], s["beta_pitch"])
    # pitch cyclic acts on the right (advancing) side, roll cyclic at the nose (moving left)
    tilt = (u_h * pitch - v_h * roll) / RO
    return rotor(v, s["Omega"], u["x_throttle"], np.hypot(u_h, v_h), w_h / RO, tilt)


def consistent_tail(v, s, u, wind=(0.0, 0.0, 0.0)):
    """Return T_T [N], positive to the left (nose right), vi_T [m/s] and lam_T (eq. 16)."""
    (u_b, v_b, w_b), (_, q, r) = air_and_body_rates(s, wind)
    R_T, Om_T, B = v["R_T"], v["K_Omega"] * s["Omega"], v["B"]
    axial = -(v_b - r * v["L_T"])
    inplane = np.hypot(u_b, w_b + q * v["L_T"])
    th0T = v["K_theta0T"] * u["x_yaw"]
    sigma_T = 2 * v["c_T"] / (np.pi * R_T)

    def thrust(vi):
        scale = v["rho"] * np.pi / 2 * R_T**4 * Om_T**2 * v["a_T"] * sigma_T
        return scale * (B**3 / 3 * th0T - B**2 / 2 * (axial + vi) / (R_T * Om_T))

    vi = by_thrust(thrust, inplane, axial, v["rho"], R_T)
    return {"T": thrust(vi), "vi": vi, "lam": (axial + vi) / (R_T * Om_T)}


def consistent_rates(v, s, u, wind=(0.0, 0.0, 0.0)):
    """Return the derivatives of the 15 states with all corrections; `wind` [m/s] in x, y, z up."""
    Om, rho = s["Omega"], v["rho"]
    T = (got := consistent_rotor(v, s, u, wind))["T"]
    air, omega = air_and_body_rates(s, wind)
    d = {k: s["d" + k] for k in ("x", "y", "z", "phi", "theta", "psi")}
    d["Omega"] = v["K_throttle"] * u["x_throttle"] - got["torque"] / v["Ir"]
    drag = -rho / 2 * np.linalg.norm(air) * np.array([v["Sx"], v["Sy"], v["Sz"]]) * air
    force = body_to_earth(s) @ (drag - [0.0, 0.0, T])
    d["dx"], d["dy"], d["dz"] = force / v["m"] - [0.0, 0.0, v["g"]]
    K = rho * v["a"] * v["c"] * (v["R2"] ** 4 - v["R1"] ** 4) / (4 * v["If"])
    tau = 2 / (K * Om)
    moment = np.zeros(3)
    for i, axis in enumerate(("roll", "pitch")):
        x, beta = u["x_" + axis], s["beta_" + axis]
        d["beta_" + axis] = (x / v["L5"] - beta) / tau - omega[i]
        gain = rho * Om**2 * v["a"] * v["c"] * v["R"] ** 4 / 8
        moment[i] = gain * (blade_cyclic(v, x, beta) - omega[i] / Om)
    moment[1] -= T * v["lr"]
    T_m = v["Ir"] * v["K_throttle"] * u["x_throttle"]
    moment[2] = v["L_T"] * consistent_tail(v, s, u, wind)["T"] + T_m
    inertia = np.array([v["Ixx"] + v["Ixx_added"], v["Iyy"] + v["Iyy_added"], v["Izz"]])
    domega = (moment - np.cross(omega, inertia * omega)) / inertia
    E, dE = euler_to_body(s)
    d["dphi"], d["dtheta"], d["dpsi"] = np.linalg.solve(
        E, domega - dE @ [s["dphi"], s["dtheta"], s["dpsi"]]
    )
    return {k: float(x) for k, x in d.items()}


RATES = {"paper": paper_rates, "consistent": consistent_rates}


def hover(v):
    """Return the trim of both variants, {variant: (s, u)}: level, at rest, psi = 0."""
    trims = {}
    for variant, rates in RATES.items():
        bar = "dbeta_pitch" if variant == "paper" else "beta_pitch"
        zero = ("dz", "dtheta", "dpsi", bar, "Omega")

        def state_and_inputs(y, names=STATES[variant]):
            Omega, x_throttle, x_pitch, x_yaw, beta_pitch = y * [100.0, 1.0, 0.001, 1.0, 0.01]
            s = dict.fromkeys(names, 0.0) | {"Omega": Omega, "beta_pitch": beta_pitch}
            return s, {"x_roll": 0.0, "x_pitch": x_pitch, "x_yaw": x_yaw, "x_throttle": x_throttle}

        def residual(y, rates=rates, zero=zero, split=state_and_inputs):
            d = rates(v, *split(y))
            return [d[k] for k in zero]

        solution = root(residual, [1.5, 0.5, 0.1, -0.25, 0.1], tol=1e-14)
        # at machine precision hybr may report slow progress, so the residual decides
        if np.max(np.abs(residual(solution.x))) > 1e-8:
            raise ValueError(f"no hover for {variant}: {solution.message}")
        trims[variant] = state_and_inputs(solution.x)
    return trims


def jacobian(variant, v, s, u, h=1e-6):
    """Return d(rates)/d(states) by central differences."""
    names, rates, columns = STATES[variant], RATES[variant], []
    for k in names:
        step = h * max(1.0, abs(s[k]))
        up, down = (rates(v, s | {k: s[k] + e}, u) for e in (step, -step))
        columns.append([(up[j] - down[j]) / (2 * step) for j in names])
    return np.array(columns).T


def main():
    for variant, (s, u) in hover(XCELL).items():
        v, Om = XCELL, s["Omega"]
        got = (paper_rotor if variant == "paper" else consistent_rotor)(v, s, u)
        residual = RATES[variant](v, s, u)
        C_T = got["T"] / (v["rho"] * np.pi * v["R"] ** 4 * Om**2)
        print(f"{variant}: residual {max(map(abs, residual.values())):.1e}")
        print({k: round(float(x), 6) for k, x in (u | s).items() if x})
        print(f"C_T {C_T:.6f}, lambda {got['lam']:.4f}, vi {got['vi']:.3f} m/s", end=", ")
        print(f"theta0 {np.degrees(v['K_theta0'] * u['x_throttle']):.3f} deg", end=", ")
        print(f"torque {got['torque']:.3f} N m, {got['torque'] * Om:.1f} W")
        for eigenvalue in sorted(
            np.linalg.eigvals(jacobian(variant, v, s, u)), key=lambda x: x.real
        ):
            print(f"  {eigenvalue:.4f}")


if __name__ == "__main__":
    main()
