"""Allowed imports between the parts of the package, read from the source."""

import ast
import functools
import graphlib
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import heli_jax

ROOT = Path(heli_jax.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))

BASE = {
    "errors", "pickled", "import_path", "regular_file", "units", "naming", "numerics", "yaml_file",
    "vehicle", "versions", "numbers", "summaries", "exports", "stages", "finding", "messages",
    "schema_keys",
}  # fmt: skip
# Parts of heli_jax that each part may import, beside itself.
ALLOWED = {
    "errors": set(),
    "finding": {"messages"},
    "messages": {"numbers", "yaml_file"},
    "regular_file": {"errors"},
    "import_path": {"errors", "regular_file"},
    "units": {"errors"},
    "pickled": set(),
    "naming": {"pickled"},
    "numerics": {"naming", "versions"},
    "versions": set(),
    "schema_keys": set(),
    "yaml_file": {"errors", "regular_file"},
    "numbers": set(),
    "stages": set(),
    "summaries": {"finding", "naming", "numbers"},
    "exports": {"naming", "summaries"},
    "vehicle": {"naming", "units", "errors", "yaml_file", "summaries"},
    "flights": {
        "stages", "numbers", "errors", "regular_file", "units", "summaries", "yaml_file",
        "import_path", "numerics", "finding",
    },
    "dynamics": {"vehicle", "naming", "numerics", "units", "errors", "pickled"},
    "linear_models": {"dynamics", *BASE},
    "simulation": {"dynamics", *BASE},
    "analysis": {"simulation", "dynamics", "flights", *BASE},
    "control": {"analysis", "simulation", "dynamics", "flights", *BASE},
    "identification": {"fused", "analysis", "simulation", "dynamics", "flights", *BASE},
    "stream": {"identification", "simulation", "dynamics", "flights", *BASE},
    "models": {"linear_models", "dynamics", *BASE},
    "fused": {"numerics"},
    "sweeps": {
        "fused", "control", "analysis", "simulation", "dynamics", "flights", "run_directory", *BASE,
    },
    "report": {
        "identification", "sweeps", "control", "analysis", "simulation", "dynamics", "flights",
        "models",
        *BASE,
    },
}  # fmt: skip
# Entry points may import everything below them, but never the command line.
ENTRY = {
    "config", "generate", "new_model", "run_directory", "workflow", "cli",
    "compatibility", "control_workflow", "design_workflow", "new_config", "studies",
    "sweep_workflow",
    "__init__",
    "__main__",
}  # fmt: skip


def part(path):
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


@functools.cache
def imported(path):
    """Yield (module, line) of every import in a file, including those in functions."""
    return tuple(_imported(path))


def _imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level:
                package = path.relative_to(ROOT.parent).parts[: -node.level]
                module = ".".join([*package, *([module] if module else [])])
            yield from ((f"{module}.{alias.name}", node.lineno) for alias in node.names)


def inner(path):
    """Return the parts of heli_jax that a file imports."""
    for module, line in imported(path):
        names = module.split(".")
        if names[0] == "heli_jax" and len(names) > 1:
            yield names[1], line


def importers(library):
    return {
        str(path.relative_to(ROOT))
        for path in FILES
        for module, _ in imported(path)
        if module.split(".")[0] == library
    }


def test_the_parts_are_known():
    assert {part(p) for p in FILES} <= set(ALLOWED) | ENTRY


@pytest.mark.parametrize("name", ALLOWED)
def test_imports_point_one_way(name):
    mine = [p for p in FILES if part(p) == name]
    assert mine
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {other}"
        for path in mine
        for other, line in inner(path)
        if other != name and other not in ALLOWED[name]
    ]
    assert not wrong


# Order within identification: each part may import the parts before it.
ROOMS = (
    "methods", "defaults", "problem", "unknowns",
    "estimation", "identifiability", "design", "validation", "equation_error", "result",
    "uncertainty",
    "restarts", "search", "diagnostics", "fit", "flight_design", "select",
)  # fmt: skip


def test_the_rooms_of_identification_import_one_way():
    home = ROOT / "identification"
    order = {room: i for i, room in enumerate(ROOMS)}
    files = [p for p in FILES if home in p.parents and p != home / "__init__.py"]
    room = {p: p.relative_to(home).parts[0].removesuffix(".py") for p in files}
    assert set(room.values()) == set(ROOMS)
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {module}"
        for path in files
        for module, line in imported(path)
        if module.startswith("heli_jax.identification.")
        and order[module.split(".")[2]] > order[room[path]]
    ]
    assert not wrong


def test_no_modules_import_each_other_in_a_circle():
    modules = {".".join(p.relative_to(ROOT.parent).with_suffix("").parts): p for p in FILES}
    graph = {
        name: {
            known
            for module, _ in imported(path)
            for known in (module, module.rpartition(".")[0])
            if known in modules and known != name
        }
        for name, path in modules.items()
    }
    graphlib.TopologicalSorter(graph).prepare()


@pytest.mark.parametrize(
    ("library", "homes"),
    [
        # simulated_flights.py uses diffrax.ForwardMode, since Levenberg-Marquardt needs that
        # derivative.
        ("diffrax", {"simulation", "identification/estimation/simulated_flights.py"}),
        ("optimistix", {"identification/estimation", "analysis/trim.py"}),
        ("lineax", {"identification/estimation"}),
        ("pydantic", {"config", "report/document.py"}),
        ("matplotlib", {"report"}),
        ("PIL", {"report/page.py"}),
        ("yaml", {"yaml_file.py"}),
        ("pint", {"units.py"}),
        ("jinja2", {"report"}),
        ("zarr", {"sweeps/store.py"}),
        ("filelock", {"sweeps/store.py"}),
        ("distributed", {"sweeps/cluster.py"}),
        (
            "pandas",
            {
                "exports.py",
                "identification/result.py",
                "report/saved_fit.py",
                "report/compared_runs.py",
            },
        ),
        ("arviz", {"exports.py"}),
        (
            "xarray",
            {
                "sweeps",
                "studies",
                "report/sweeps.py",
                "report/responses.py",
                "cli/simulations.py",
                "flights/convert.py",
                "exports.py",
                "report/sample_files.py",
                "simulation/trajectory.py",
                "sweep_workflow.py",
            },
        ),
        ("pickle", set()),
        ("marshal", set()),
        ("shelve", set()),
        # For objects that a script passes between processes; files are never pickled.
        ("cloudpickle", {"pickled.py"}),
        ("dill", set()),
    ],
)
def test_libraries_stay_at_home(library, homes):
    def at_home(file):
        return file in homes or any(file.startswith(f"{home}/") for home in homes)

    assert [file for file in sorted(importers(library)) if not at_home(file)] == []


def test_nothing_evaluates_text():
    wrong = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("eval", "exec", "compile", "__import__")
    ]
    assert not wrong


def test_importing_changes_no_setting_and_prints_nothing():
    modules = [
        ".".join(("heli_jax", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(
            ".__init__"
        )
        for path in FILES
        if path.stem not in ("cli", "__main__")
    ]
    program = (
        "import importlib, json, logging, sys, warnings\n"
        "import jax, equinox, diffrax, optimistix\n"
        "def now():\n"
        "    return [repr(sorted(jax.config.values.items(), key=str)), logging.root.level,\n"
        "            len(logging.root.handlers), len(warnings.filters)]\n"
        "before = now()\n"
        f"for name in {modules!r}:\n"
        "    importlib.import_module(name)\n"
        "assert now()[:3] == before[:3], 'a setting changed'\n"
        "assert not jax.config.jax_enable_x64\n"
        "light = sys.modules.keys() & {'matplotlib.pyplot'}\n"
        "print(json.dumps(sorted(light)))\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False
    )
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout) == []


def test_the_package_itself_imports_nothing_heavy():
    program = "import sys, heli_jax; print(sorted({'jax', 'diffrax', 'pydantic'} & {*sys.modules}))"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "[]"


def test_what_other_commands_import_is_without_the_sweeps_libraries():
    program = (
        "import sys\n"
        "from heli_jax import config, generate\nfrom heli_jax.cli import fits\n"
        "heavy = {'zarr', 'xarray', 'pandas', 'distributed', 'scipy.stats'} & {*sys.modules}\n"
        "from heli_jax import workflow\n"
        "print(sorted(heavy | {'matplotlib', 'PIL'} & {*sys.modules}))"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "[]"


def test_every_name_at_the_top_exists():
    for name in dir(heli_jax):
        assert getattr(heli_jax, name) is not None
    assert importlib.import_module("heli_jax.models") is heli_jax.models
    with pytest.raises(AttributeError, match="nothing"):
        heli_jax.nothing  # noqa: B018
    sweeps = importlib.import_module("heli_jax.sweeps")
    for name in dir(sweeps):
        assert getattr(sweeps, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        sweeps.nothing  # noqa: B018
