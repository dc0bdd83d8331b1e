"""Checks of a flight's values that say more than types would."""

import math
from typing import Any

# Any: whatever YAML holds.


def window_choice(value: Any) -> Any:
    """Two numbers of seconds or auto, before pydantic.

    Args:
        value: as it stands in the configuration.

    Raises:
        ValueError: it is neither.
    """
    # By hand: of a union pydantic would report every member.
    if value is None or value == "auto":
        return value
    if isinstance(value, list | tuple) and len(value) == 2:
        numbers = [v for v in value if isinstance(v, int | float) and not isinstance(v, bool)]
        if len(numbers) == 2 and all(math.isfinite(v) for v in numbers):
            return value
    raise ValueError(f"expected two finite numbers of seconds or auto, got {value!r:.60}")


def one_log(value: Any) -> Any:
    """One log, before pydantic.

    Args:
        value: as it stands in the configuration.

    Raises:
        ValueError: it is a list.
    """
    # A study takes the list away before: what still has one is read by another command.
    if isinstance(value, list):
        raise ValueError(
            "expected one log, got a list, which makes a study of fits (heli-jax fit, "
            "heli_jax.run_study)"
        )
    return value
