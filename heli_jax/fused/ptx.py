"""A program for whole runs on a GPU of NVIDIA's, one vehicle a thread: as text in PTX.

PTX is the assembly language that the driver itself turns into machine code, so that nothing but the
driver is needed where it runs. The functions that LLVM has no instructions for (sin, exp, ...) come
from NVIDIA's libdevice, which JAX needs too and brings with it.
"""

import importlib.util
import os
import re
from pathlib import Path
from typing import Any

from heli_jax.fused.code import Target, UnsupportedError
from heli_jax.fused.program import Run, Text, write

_TRIPLE = "nvptx64-nvidia-cuda"
_FROM_LIBDEVICE = {
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh"),
    *("exp", "exp2", "log", "log2", "pow", "log1p", "expm1", "cbrt"),
    *("asinh", "acosh", "atanh", "erf", "erfc", "fmod"),
}
# What LLVM has a description of; a later GPU runs the last one's program as well.
_KNOWN = (70, 72, 75, 80, 86, 87, 89, 90)


def _function(name: str, kind: str) -> str | None:
    if name not in _FROM_LIBDEVICE:
        return None
    return f"__nv_{name}{'f' if kind == 'float' else ''}"


TARGET = Target(1, threads=True, memory=" addrspace(1)", functions=_function)


def ptx(run: Run, capability: int) -> tuple[str, Text]:
    """A run's program in PTX, and what it was made of.

    Args:
        run: what is computed.
        capability: of the GPU, such as 90 for 9.0.

    Raises:
        UnsupportedError: an operation that has no translation, a GPU that is too old, or a function
            for which libdevice is needed and not found.
    """
    text = write(run, TARGET)
    return assembled(text.assembly, capability), text


def assembled(assembly: str, capability: int) -> str:
    """What LLVM makes of a program in its language, in PTX.

    Raises:
        UnsupportedError: as `ptx`.
    """
    import llvmlite.binding as llvm

    known = [c for c in _KNOWN if c <= capability]
    if not known:
        raise UnsupportedError(f"a GPU of compute capability {capability / 10:.1f}")
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    # What JAX needs of the driver, CUDA 12, reads this version of the language.
    machine = llvm.Target.from_triple(_TRIPLE).create_target_machine(
        cpu=f"sm_{known[-1]}", features="+ptx80", opt=3
    )
    module = llvm.parse_assembly(f'target triple = "{_TRIPLE}"\n{assembly}')
    module.data_layout = str(machine.target_data)
    needed = re.findall(r"declare .*@__nv_(\w+)\(", assembly)
    if needed:
        _link(module, machine, needed[0])
    module.verify()
    tuning = llvm.create_pipeline_tuning_options(speed_level=3)
    builder = llvm.create_pass_builder(machine, tuning)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_assembly(module)


def _link(module: Any, machine: Any, needed: str) -> None:
    """Put the functions of libdevice into a program."""
    import llvmlite.binding as llvm

    path = libdevice()
    if path is None:
        raise UnsupportedError(f"{needed} without libdevice.10.bc, which CUDA brings, or CUDA_HOME")
    library = llvm.parse_bitcode(path.read_bytes())
    library.triple, library.data_layout = _TRIPLE, str(machine.target_data)
    module.link_in(library)
    for function in module.functions:
        if function.name != "run" and not function.is_declaration:
            # What is not called is left out then.
            function.linkage = "internal"


def libdevice() -> Path | None:
    """NVIDIA's library of functions, where CUDA or a package of it is installed."""
    roots = [os.environ.get(n) for n in ("CUDA_HOME", "CUDA_PATH")]
    roots.append("/usr/local/cuda")
    package = importlib.util.find_spec("nvidia")
    # One package for each part of CUDA 12, and one folder for all parts of CUDA 13.
    for place in [] if package is None else package.submodule_search_locations or []:
        roots += [str(Path(place) / part) for part in ("cuda_nvcc", "cu13", "cu12")]
    for root in roots:
        path = Path(root or "/nowhere") / "nvvm" / "libdevice" / "libdevice.10.bc"
        if path.is_file():
            return path
    return None
