"""`heli-jax new-model NAME`: the files that a model of one's own begins with, commented."""

import importlib.util
import keyword
import string
import sys
from importlib import resources
from pathlib import Path

from heli_jax.errors import InputError
from heli_jax.run_directory import require_free, whole

_FILES = {
    "model.py.txt": "$name.py",
    "vehicle.yaml.txt": "$name-vehicle.yaml",
    "config.yaml.txt": "$name.yaml",
    "test.py.txt": "test_$name.py",
}
"""template in this folder, file that is made of it"""


def write_skeleton(name: str, folder: str | Path | None = None) -> list[Path]:
    """Write a model that runs as it stands: module, vehicle, configuration and test.

    Args:
        folder: a new one; one called `name` in the working directory unless given.

    Returns:
        The files, the module first.

    Raises:
        InputError: the name is none, or that of a module that is installed; the folder exists.
    """
    if keyword.iskeyword(name) or not name.isascii() or not name.isidentifier():
        raise InputError(
            f"new-model: got {name!r:.60}, expected a name of letters, digits and _ that does not "
            "begin with a digit, and no keyword of Python"
        )
    folder = Path(name) if folder is None else Path(folder)
    require_free(folder)
    # A module of that name would be imported in its place, or hide it from everybody else.
    if name in sys.stdlib_module_names or importlib.util.find_spec(name) is not None:
        raise InputError(
            f"new-model: {name!r} is the name of an installed module, expected another one"
        )
    with whole(folder) as made:
        for template, target in _FILES.items():
            text = resources.files(__name__).joinpath(template).read_text(encoding="utf-8")
            place = made / string.Template(target).substitute(name=name)
            place.write_text(string.Template(text).substitute(name=name), encoding="utf-8")
    return [folder / string.Template(target).substitute(name=name) for target in _FILES.values()]
