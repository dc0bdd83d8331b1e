"""The models that ship, and how a configuration's name of a model becomes one."""

import importlib
import re
import sys
from pathlib import Path

from heli_jax.dynamics.helicopter import helicopter
from heli_jax.dynamics.model import Model
from heli_jax.dynamics.roll import on_stand, pitch, roll
from heli_jax.errors import InputError, nearest

roll_on_stand = on_stand(roll)
pitch_on_stand = on_stand(pitch)

__all__ = ["by_name", "helicopter", "on_stand", "pitch", "pitch_on_stand", "roll", "roll_on_stand"]

_SHIPPED = {model.name: model for model in (roll, roll_on_stand, pitch, pitch_on_stand)}


def by_name(name: str, where: str = "model", folder: str | Path | None = None) -> Model:
    """The shipped model of that name, or anyone's own at 'package.module:name'.

    A module of one's own may lie in `folder`, as beside the configuration that names it.

    Raises:
        InputError: neither exists; `where` begins the sentence.
    """
    if name in _SHIPPED:
        return _SHIPPED[name]
    if not re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", name):
        known = [*_SHIPPED, "package.module:name"]
        raise InputError(f"{where}: unknown model {name!r}{nearest(name, known)}")
    module_name, attribute = name.split(":")
    if folder is not None and str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    try:
        module = importlib.import_module(module_name)
    except (ImportError, SyntaxError) as e:
        raise InputError(f"{where}: cannot import {module_name!r} for {name!r} ({e})") from e
    model = getattr(module, attribute, None)
    if not isinstance(model, Model):
        found = "nothing" if model is None else f"a {type(model).__name__}"
        raise InputError(f"{where}: {name!r} is {found}, wanted is a heli_jax.Model")
    return model
