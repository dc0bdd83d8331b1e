"""Versions of the software behind the results."""

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
    """Return the versions of Python and of the packages that affect numbers."""
    # Read the metadata of installed distributions. Some packages have no __version__, and this
    # imports none.
    packages = {}
    for name in _PACKAGES:
        # llvmlite is an extra.
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            packages[name] = importlib.metadata.version(name)
    return {"python": platform.python_version(), **packages}


def changed_since(old: Mapping[str, str]) -> str:
    """Return the versions that have changed since the work began, in words; empty if none has."""
    changed = [f"{n} {old[n]} then, {v} now" for n, v in versions().items() if old.get(n, v) != v]
    return f"begun with other versions ({', '.join(changed)}): last digits may differ" * bool(
        changed
    )
