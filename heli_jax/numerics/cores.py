"""Number of processor cores that may be used."""

import os


def cores() -> int:
    """Processor cores that this process may use."""
    # A batch system may grant a few of the vehicle's cores: cpu_count() would tell all of them.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
