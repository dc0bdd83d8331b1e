"""PX4 ULog files (.ulg), read by pyulog in a separate process."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.finding import note
from heli_jax.flights.formats.apart import Content, read_apart
from heli_jax.flights.log import Budget, ChannelLog, Topic, require_samples, wrong
from heli_jax.regular_file import read_regular

MAGIC = b"ULog\x01\x12\x35"
_LARGEST = 2 * 10**9
_FAR = 86_400_000_000
"""Distance [us] of a damaged stamp from its topic's others: a day."""
_COMMANDS = ("actuator_", "vehicle_torque_setpoint", "vehicle_thrust_setpoint")
"""Topics whose `timestamp_sample` is that of the gyro sample they react to; commands act when they
are published."""


def open_ulog(path: Path) -> ChannelLog:
    """Open the flight of a ULog file.

    The times of a topic are `timestamp_sample`, when the sample was taken, if the topic has it.
    Otherwise, and for commands, they are `timestamp`, when it was published.
    """
    data = read_regular(path, "a ULog file", _LARGEST)
    if len(data) < 16 or not data.startswith(MAGIC):
        raise wrong(str(path), "is no ULog file, expected one that begins with its mark")
    facts, arrays, notes = read_apart(path, read_ulog, "ULog file", len(data))
    topics, columns = [], iter(arrays)
    for name, clock, names in facts["topics"]:
        values = {f"{name}.{n}": next(columns) for n in names}
        stamps = (f"{name}.timestamp", f"{name}.timestamp_sample")
        units = {n: "us" for n in stamps if n in values}
        topics.append(Topic(name, values[f"{name}.{clock}"] * 1e-6, values, units, clock))
    require_samples(str(path), topics)
    return ChannelLog(
        path=str(path),
        format="ulog",
        size=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
        topics=tuple(topics),
        firmware=_firmware(facts["information"]),
        parameters=facts["parameters"],
        notes=tuple(notes),
        start=facts["start"] * 1e-6,
    )


def read_ulog(path: Path, budget: Budget) -> Content:
    """Read all topics; their columns are in the order of the facts' `topics`."""
    from pyulog import ULog
    from pyulog.exceptions import ULogIncompatibleFlagException

    try:
        log: Any = ULog(str(path))
    except ULogIncompatibleFlagException as e:
        problem = "is a ULog file of a kind that is not known, expected version 1"
        raise wrong(str(path), problem) from e
    parts: dict[tuple[str, int], list[Mapping[str, np.ndarray]]] = {}
    odd = 0
    for data in log.data_list:
        if "timestamp" not in data.data:
            continue
        budget.take(sum(values.nbytes for values in data.data.values()))
        stamps = data.data["timestamp"].astype(np.float64)
        near = np.abs(stamps - np.median(stamps)) <= _FAR
        odd += int(np.count_nonzero(~near))
        columns = {n: x[near] for n, x in data.data.items() if "_padding" not in n}
        parts.setdefault((data.name, data.multi_id), []).append(columns)
    topics, arrays = [], []
    for (name, instance), rows in parts.items():
        # A topic may be subscribed to more than once; its rows are then joined.
        columns = {n: np.concatenate([part[n] for part in rows]) for n in rows[0]}
        several = sum(other == name for other, _ in parts) > 1
        shown = f"{name}[{instance}]" if several or instance else name
        topics.append((shown, _clock(name, columns), list(columns)))
        arrays += columns.values()
    notes = []
    if odd or log.file_corruption:
        words = "damaged messages are left out"
        notes.append(
            note("damage.skipped", f"{words}; {odd} rows had times of other days", value=odd)
        )
    if log.dropouts:
        lost = 1e-3 * sum(d.duration for d in log.dropouts)
        words = f"logger dropouts: {len(log.dropouts)}, {lost:.3g} s in all"
        notes.append(note("damage.dropouts", words, value=lost))
    facts = {
        "topics": topics,
        "information": {n: v for n, v in log.msg_info_dict.items() if not isinstance(v, bytes)},
        "parameters": log.initial_parameters,
        "start": log.start_timestamp,
    }
    return Content(facts, arrays, notes)


def _clock(name: str, columns: Mapping[str, np.ndarray]) -> str:
    if "timestamp_sample" in columns and not any(topic in name for topic in _COMMANDS):
        stamps = columns["timestamp_sample"]
        # Some modules leave the field at zero, or publish one sample twice.
        if stamps.dtype.kind == "u" and stamps[0] > 0 and np.all(stamps[1:] > stamps[:-1]):
            return "timestamp_sample"
    return "timestamp"


def _firmware(information: Mapping[str, str | int]) -> str:
    release = information.get("ver_sw_release")
    version = str(information.get("ver_sw", ""))[:12]
    if isinstance(release, int) and release >> 24 & 0xFF:
        version = f"{release >> 24 & 0xFF}.{release >> 16 & 0xFF}.{release >> 8 & 0xFF}"
    parts = (information.get("sys_name", ""), information.get("ver_hw", ""), version)
    return " ".join(str(part) for part in parts if part)
