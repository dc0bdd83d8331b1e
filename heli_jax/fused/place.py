"""Where an operation comes from that JAX traced: the line of a model, or a library."""

import re
from pathlib import Path
from typing import Any

_OURS = str(Path(__file__).parents[1])
_INSTALLED = re.compile(r"(?:site|dist)-packages[/\\]([^/\\.]+)")


def place_of(equation: Any) -> str | None:
    """As 'at model.py:12' or 'in diffrax'; None where nothing says so."""
    trace, library = equation.source_info.traceback, None
    # From the innermost call outwards, until somebody's own function is met. What a function of
    # JAX's is made of was traced once for all who call it, and knows no caller.
    for frame in () if trace is None else trace.frames:
        name = frame.file_name
        if name.startswith(_OURS):
            return None if library in (None, "jax", "jaxlib") else f"in {library}"
        if (installed := _INSTALLED.search(name)) is not None:
            library = installed[1]
        elif not name.startswith("<"):
            return f"at {Path(name).name}:{frame.line_num}"
    return None
