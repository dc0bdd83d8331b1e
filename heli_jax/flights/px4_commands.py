"""Which topics of PX4 hold what the autopilot commands, in a ULog or in a table made of one."""

import re
from collections.abc import Sequence
from pathlib import PurePath

_TOPICS = ("actuator_", "vehicle_torque_setpoint", "vehicle_thrust_setpoint")
"""how they are called; their `timestamp_sample` is that of the gyro's sample that they answer"""
# As ulog2csv names its files, LOG_TOPIC_INSTANCE.csv: LOG may hold any word, so the end counts.
_FILE = re.compile(
    r"(?:^|_)(?:actuator_(?:controls|motors|servos)|vehicle_(?:torque|thrust)_setpoint)"
    r"(?:_virtual)?(?:_[a-z]{2})?(?:_\d+){0,2}"
)
_FIELD = re.compile(r"control(?:\[\d+\]|\.\d+)")
"""of controls, motors and servos alone: what is left of a topic where a file was renamed"""


def is_command(topic: str) -> bool:
    """Whether a topic of a ULog holds commands."""
    return topic.startswith(_TOPICS)


def are_commands(path: str, stamps: str, names: Sequence[str]) -> bool:
    """Whether a table's columns are those of a topic of commands.

    Args:
        path: of the file.
        stamps: a column of times, perhaps with the topic before it: `/actuator_motors/timestamp`.
        names: of the table's columns.
    """
    *_, topic, _ = ("", *re.split(r"[./]", stamps))
    if topic:
        return is_command(topic)
    stem = PurePath(path).name.split(".")[0]
    found = list(_FILE.finditer(stem.casefold()))
    return any(m.end() == len(stem) for m in found) or any(map(_FIELD.fullmatch, names))
