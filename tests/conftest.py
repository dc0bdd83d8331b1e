"""Test settings: float64, strict dtypes and ranks, checked shapes, and reproducible examples."""

import atexit
import gc
import os
import shutil
import tempfile
import time
from pathlib import Path

# Set before JAX is imported: the test processes of a run share compiled programs.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _compiled = tempfile.mkdtemp(prefix="heli_jax-tests-")
    atexit.register(shutil.rmtree, _compiled, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"

# Tests spend most of their time in XLA's compiler. CI compiles without optimisation, in 70 % of the
# time.
if os.environ.get("CI") == "true":
    os.environ.setdefault(
        "XLA_FLAGS",
        "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true",
    )

import hypothesis
import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Install the hook before the package's first import: it checks annotated shapes. Some modules are
# left out. beartype cannot check the Table of flights, a Protocol that is not runtime_checkable.
# The equations accept any record with the names of a Helicopter. identification.problem takes a
# list of flights for a tuple. Tests of equation_error.rls and analysis.lti pass wrong arguments.
_CHECKED = (
    "vehicle naming dynamics.model dynamics.jacobians dynamics.disturbance simulation "
    "numerics.hoist numerics.matrix_exponential "
    "analysis.linear identification.unknowns.transforms identification.validation.metrics "
    "identification.estimation.residual identification.estimation.simulated_flights"
)
jaxtyping.install_import_hook([f"heli_jax.{p}" for p in _CHECKED.split()], "beartype.beartype")

hypothesis.settings.register_profile(
    "same", derandomize=True, deadline=None, max_examples=30, database=None
)
hypothesis.settings.load_profile("same")


_MAPPED = 42_000
"""Memory regions above which compiled programs are released; Linux kills a process above 65530."""


# Imported objects live as long as the process; frozen, they are not scanned beside traced objects.
gc.freeze()
gc.set_threshold(50_000, 20, 50)


@pytest.fixture(autouse=True)
def _programs_are_let_go():
    began = time.monotonic()
    yield
    regions = Path("/proc/self/maps")
    if time.monotonic() - began < 1.0 or not regions.exists():
        return
    if regions.read_bytes().count(b"\n") > _MAPPED:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def vehicles_folder():
    return Path(__file__).parents[1] / "configs" / "vehicles"


@pytest.fixture(scope="session")
def bench30(vehicles_folder):
    from heli_jax import load_vehicle

    return load_vehicle(vehicles_folder / "bench-30.yaml")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the slowest tests in CI, where smaller tests show the same."""
    if os.environ.get("CI") != "true":
        return
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.skip(reason="slow: left out where CI=true"))
