"""Settings of JAX for all commands."""

import contextlib
import os
from pathlib import Path

from heli_jax.errors import InputError


def prepare_jax(cpu_devices: int | None = None) -> None:
    """Set float64 and a compilation cache for all programs. Only entry points call this.

    Args:
        cpu_devices: number of processors that are devices; default: JAX decides.
    """
    # Commands import JAX and its users themselves. It takes seconds, which a wrong option, --help
    # and `info` do not need.
    import jax

    jax.config.update("jax_enable_x64", True)
    # Source locations of traced operations serve only for debugging compiled programs, and take 5 %
    # of the time of `check`.
    jax.config.update("jax_include_full_tracebacks_in_locations", False)
    jax.config.update("jax_traceback_in_locations_limit", 0)
    # JAX caches only programs that took over a second to compile. A fit has dozens of small ones,
    # which add up to seconds.
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", _private_cache())
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if cpu_devices is not None:
        # The number of devices is fixed once JAX is in use.
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", cpu_devices)
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms in ("", "cpu"):
        return
    try:
        jax.devices()
    # JAX raises AssertionError if its plugin for the device is installed but the device is missing.
    except (RuntimeError, AssertionError) as e:
        raise InputError(
            f"JAX_PLATFORMS={platforms}: JAX finds no such device here; use JAX_PLATFORMS=cpu, or "
            "for an NVIDIA GPU install its driver and the extra gpu: pip install 'heli_jax[gpu]'"
        ) from e


def _private_cache() -> str | None:
    """Return the cache folder if it is this user's own, since it contains executable code."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "heli_jax"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)  # fails for another user's folder, unless run as root
        owner = folder.stat().st_uid
    except OSError:
        return None
    return str(folder) if getattr(os, "getuid", lambda: owner)() == owner else None
