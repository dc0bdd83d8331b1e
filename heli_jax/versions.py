"""Versions of what numbers came from."""

import importlib.metadata
import platform

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
    """That of heli_jax, as installed."""
    return importlib.metadata.version("heli_jax")


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that numbers depend on."""
    # Of the installed distributions: not every package has a __version__, and none is imported.
    packages = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return {"python": platform.python_version(), **packages}
