"""float64, strict dtypes and ranks, checked shapes, and examples that are the same every time."""

import atexit
import gc
import os
import shutil
import tempfile
import time
from pathlib import Path

# Before JAX: what one test process has compiled serves the others of the same run.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _compiled = tempfile.mkdtemp(prefix="heli_jax-tests-")
    atexit.register(shutil.rmtree, _compiled, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"

# A test spends most of its time in XLA's compiler, and calls what it makes once or twice: in CI it
# compiles without optimisation, in 70 % of the time.
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

# Before the package's first import: the hook checks the shapes that its annotations state.
# Left out are modules that are called with other types than their annotations say:
# flights (beartype cannot check its Table, a Protocol that is not runtime_checkable), the equations
# (any record with the names of a Helicopter passes for one, such as with_disturbance's),
# identification.problem (takes a list of flights for a tuple), equation_error.rls and analysis.lti
# (their own errors for wrong arguments are tested).
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
"""Regions of memory above which compiled programs are let go: Linux grants a process 65530, every
kernel takes some, and past them the process dies."""


# What is imported lives as long as the process; tracing makes millions of objects beside it.
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
    """CI leaves the slowest tests out: what each shows is shown there by a smaller one too."""
    if os.environ.get("CI") != "true":
        return
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.skip(reason="slow: left out where CI=true"))
