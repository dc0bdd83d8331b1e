"""Pickling of functions and classes that are made at run time.

A model holds closures, and its records are classes that no module has by name. pickle stores names
and refuses both; `cloudpickle` stores their content. This module writes no file: it is for
`multiprocessing`, `joblib` and `copy`.
"""

from typing import Any

import cloudpickle


def by_value(self: Any) -> tuple[Any, ...]:
    """Return the result of `__reduce__`: the class and the object, both by value.

    Args:
        self: a named tuple, or an object whose fields are its `__dict__`.
    """
    content = tuple(self) if isinstance(self, tuple) else dict(vars(self))
    return _restored, (cloudpickle.dumps((type(self), content)),)


def _restored(stored: bytes) -> Any:
    made, content = cloudpickle.loads(stored)
    if isinstance(content, tuple):
        return made(*content)
    restored = object.__new__(made)
    # Bypass the class, which may be frozen.
    for name, value in content.items():
        object.__setattr__(restored, name, value)
    return restored
