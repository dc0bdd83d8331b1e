"""Number of processor cores that may be used."""

import os


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    # A batch system may grant fewer cores than cpu_count() returns.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
