"""A GPU that is none: its program is run on the processor, thread after thread.

What LLVM is given for a GPU is taken as it is but for what a processor has no word for: which
thread this is, the space of memory, and libdevice's functions.
"""

import ctypes
import re

import llvmlite.binding as llvm

from heli_jax.fused.program import write
from heli_jax.fused.ptx import TARGET

_PLACES = ("tid", "ctaid", "ntid", "nctaid")


def as_text(run, capability):
    """In place of `ptx`: the program before it is made PTX."""
    text = write(run, TARGET)
    return text.assembly, text


def for_this_processor(assembly):
    """The same program with the thread's place read from memory."""
    text = assembly.replace(" addrspace(1)", "").replace("ptx_kernel ", "")
    text = re.sub(
        r"@__nv_(\w+?)(f?)\(",
        lambda m: f"@llvm.{m[1]}.{'f32' if m[2] else 'f64'}(",
        text,
    )
    for place in _PLACES:
        name = f"@llvm.nvvm.read.ptx.sreg.{place}.x"
        text = text.replace(f"declare i32 {name}()", "").replace(f"{name}()", f"@read_{place}()")
        text += f"@{place} = global i32 0\n"
        text += f"define i32 @read_{place}() {{\n  %v = load i32, ptr @{place}\n  ret i32 %v\n}}\n"
    return text


class EmulatedGpu:
    """As `cuda_driver.Gpu`, on the processor."""

    def __init__(self):
        self.capability, self.processors = 90, 1
        self.launched = []

    def load(self, assembly):
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        machine = llvm.Target.from_default_triple().create_target_machine()
        module = llvm.parse_assembly(for_this_processor(assembly))
        module.verify()
        engine = llvm.create_mcjit_compiler(module, machine)
        engine.finalize_object()
        kinds = [ctypes.c_void_p] * 4 + [ctypes.c_int64] * 3
        run = ctypes.CFUNCTYPE(None, *kinds)(engine.get_function_address("run"))
        at = {n: ctypes.c_int32.from_address(engine.get_global_value_address(n)) for n in _PLACES}

        def launch(blocks, threads, arguments, _kept=engine):
            self.launched.append((blocks, threads))
            at["ntid"].value, at["nctaid"].value = threads, blocks
            for block in range(blocks):
                for thread in range(threads):
                    at["ctaid"].value, at["tid"].value = block, thread
                    run(*arguments)

        return launch
