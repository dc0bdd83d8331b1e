"""Objects of functions and classes that are made at run time, through pickle.

A model holds closures, its records are classes that no module has by name: pickle, which stores
names, refuses both. `cloudpickle` stores what they are. Nothing here writes a file: it is for
`multiprocessing`, `joblib` and `copy`.
"""

from typing import Any

import cloudpickle


def by_value(self: Any) -> tuple[Any, ...]:
    """Return `__reduce__`'s answer: the class with the object, both by value.

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
    # Past the class, which may be frozen.
    for name, value in content.items():
        object.__setattr__(restored, name, value)
    return restored
