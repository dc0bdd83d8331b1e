"""Versions of what numbers came from."""

import contextlib
import importlib.metadata
import platform
from collections.abc import Mapping

_PACKAGES = (
    "heli_jax",
    "jax",
    "jaxlib",
    "equinox",
    "diffrax",
    "optimistix",
    "numpy",
    "scipy",
    "llvmlite",
)


def version() -> str:
    """Return the installed version of heli_jax."""
    return importlib.metadata.version("heli_jax")


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that numbers depend on."""
    # Of the installed distributions: not every package has a __version__, and none is imported.
    packages = {}
    for name in _PACKAGES:
        # llvmlite is an extra.
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            packages[name] = importlib.metadata.version(name)
    return {"python": platform.python_version(), **packages}


def changed_since(old: Mapping[str, str]) -> str:
    """Say which versions differ from those that work was begun with; empty where none does."""
    changed = [f"{n} {old[n]} then, {v} now" for n, v in versions().items() if old.get(n, v) != v]
    return f"begun with other versions ({', '.join(changed)}): last digits may differ" * bool(
        changed
    )
