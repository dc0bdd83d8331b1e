"""Tables made of PX4's logs, one topic each as ulog2csv writes them, and their clocks."""

import numpy as np
import pytest

from heli_jax.flights.describe import describe_flights

STEP = 4000
LATE = 1500
"""us from the gyro's sample to the publication of what answers it"""


def _write(path, names):
    stamps = 20_000_000 + STEP * np.arange(100)
    columns = {"timestamp": stamps + LATE + np.arange(100) % 7, "timestamp_sample": stamps}
    columns |= {"time": (stamps - stamps[0]) * 1e-6}
    stick = 1e-3 * stamps
    rows = [columns.get(n.split("/")[-1], stick) for n in names]
    np.savetxt(path, np.column_stack(rows), "%.9g", ",", header=",".join(names), comments="")
    return str(path)


TWO = ("timestamp", "timestamp_sample")
MOTORS = tuple(f"/actuator_motors/{n}" for n in (*TWO, "control.00"))


@pytest.mark.parametrize(
    ("file", "names", "clock"),
    [
        ("log_actuator_controls_0_0.csv", (*TWO, "x"), TWO[0]),
        ("log_vehicle_torque_setpoint_0.csv", (*TWO, "x"), TWO[0]),
        ("vehicle_thrust_setpoint_virtual_mc_0.csv", (*TWO, "x"), TWO[0]),
        ("sticks.csv", (*TWO, "control[0]"), TWO[0]),
        ("log_vehicle_angular_velocity_0.csv", (*TWO, "xyz[0]"), TWO[1]),
        ("actuator_motors_vehicle_angular_velocity_0.csv", (*TWO, "xyz[0]"), TWO[1]),
        ("a.csv", MOTORS, MOTORS[0]),
        ("b.csv", ("time", "vehicle_imu.timestamp_sample", "x"), "time"),
    ],
)
def test_a_command_acts_from_when_it_was_published_in_a_table_too(tmp_path, file, names, clock):
    (info,) = describe_flights(_write(tmp_path / file, names))
    assert info.time.column == clock
