"""Programs that JAX traced, kept from one process to the next.

To trace the residual and its derivatives and to lower them takes a quarter of `heli-jax check`, as
often as it is called; what XLA compiles is kept by JAX itself. What is kept here is StableHLO as
`jax.export` writes it, found by a digest of all that it hangs on: the files of this package, the
versions of the libraries, the function, types and shapes of its arguments, and the content of what
is static in them. Where any of that cannot be told (a model of one's own), and where nobody named a
folder, it is traced as ever.
"""

import contextlib
import functools
import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.export
import numpy as np
from jax.core import Tracer

from heli_jax import versions
from heli_jax.numerics.jitted import jitted
from heli_jax.numerics.stored_content import Unknown, content, named

_MOST = 200
"""programs in the folder; above it the oldest go"""
_LARGEST = 20_000_000
"""bytes of one, above which it is not kept"""

_SETTINGS = (
    *("jax_enable_x64", "jax_default_matmul_precision", "jax_default_prng_impl"),
    *("jax_numpy_dtype_promotion", "jax_numpy_rank_promotion", "jax_threefry_partitionable"),
    *("jax_debug_nans", "jax_debug_infs", "jax_disable_jit", "jax_enable_checks"),
)
"""of JAX's configuration, that change what is traced or how it runs"""

_folder: list[Path] = []


def keep_in(folder: Path | None) -> None:
    """From now on programs are kept in a folder of this user's; with None no longer."""
    _folder[:] = [] if folder is None else [folder]


def stored[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """`jitted` whose programs are kept where `keep_in` was called.

    Args:
        function: of this package, of arrays and static arguments by position; returns arrays in
            tuples, lists, dictionaries and named tuples.
    """
    plain = jitted(function)
    programs: dict[Any, Callable[..., Any] | None] = {}

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not _folder or kwargs:
            return plain(*args, **kwargs)
        traced, static = eqx.partition(args, eqx.is_array)
        leaves, structure = jax.tree.flatten(traced)
        if not all(map(_plain, leaves)):
            return plain(*args, **kwargs)
        fixed, shape = jax.tree.flatten(static)
        types = tuple(map(type, fixed))  # 1, 1.0 and True are equal, and traced otherwise
        key = (structure, shape, tuple(fixed), types, tuple((v.dtype, v.shape) for v in leaves))
        if key not in programs:
            programs[key] = _program(function, args, _folder[0])
        program = programs[key]
        return plain(*args, **kwargs) if program is None else program(leaves)

    return call


def _plain(leaf: Any) -> bool:
    """Whether an argument is of this process's one processor, and not being traced."""
    if isinstance(leaf, np.ndarray | np.generic):
        return True
    if isinstance(leaf, Tracer) or leaf.aval.weak_type:
        return False
    return leaf.sharding.device_set == {jax.devices()[0]}


def _program(
    function: Callable[..., Any], args: tuple[Any, ...], folder: Path
) -> Callable[..., Any] | None:
    """A function of the leaves of the arrays among the arguments; None where nothing is kept."""
    if jax.default_backend() != "cpu":
        return None
    try:
        digest = hashlib.sha256(
            _surroundings() + _settings() + _named(function) + content(args)
        ).hexdigest()
    except Unknown:
        return None
    path = folder / digest
    program = _read(path)
    if program is None:
        program = _traced(function, args)
        if program is None:
            return None
        _write(path, *program)
    exported, outline = program
    run = jax.jit(exported.call)

    def called(leaves: list[Any]) -> Any:
        # Through NumPy: JAX has what an exported program returns belong to one device, and all that
        # it goes into would be compiled for that device once more.
        made = jax.device_put([np.asarray(v) for v in run(*leaves)])
        return _rebuilt(outline, iter(made))

    return called


def _named(function: Callable[..., Any]) -> bytes:
    return f"{function.__module__}:{function.__qualname__}\n".encode()


@functools.cache
def _surroundings() -> bytes:
    """What a program hangs on beside the function and its arguments."""
    sources = hashlib.sha256()
    package = str(Path(__file__).parents[1])
    # By `os`, since a path for each of the files takes twice as long as to read them.
    of_package = sorted(
        os.path.join(folder, name)
        for folder, _, names in os.walk(package)
        for name in names
        if name.endswith(".py")
    )
    for path in of_package:
        sources.update(path.removeprefix(package).encode())
        with open(path, "rb", buffering=0) as source:
            sources.update(source.read())
    return f"{sources.hexdigest()} {versions.versions()} {os.cpu_count()}\n".encode()


def _settings() -> bytes:
    """How JAX traces."""
    named = {k: v for k, v in os.environ.items() if k.startswith(("JAX_", "XLA_"))}
    named.pop("JAX_COMPILATION_CACHE_DIR", None)
    named |= {name: str(getattr(jax.config, name, None)) for name in _SETTINGS}
    return f"{sorted(named.items())}\n".encode()


def _traced(
    function: Callable[..., Any], args: tuple[Any, ...]
) -> tuple[jax.export.Exported, Any] | None:
    """The exported program and the outline of what it returns."""
    traced, static = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(traced)
    outlines: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        made = function(*eqx.combine(jax.tree.unflatten(structure, leaves), static))
        outlines.append(_outline(made))
        return jax.tree.leaves(made)

    shapes = [jax.ShapeDtypeStruct(v.shape, v.dtype) for v in leaves]
    try:
        exported = jax.export.export(jax.jit(flat))(*shapes)
    # Whatever it is: of the function's own, which says it again as it is traced as ever, or
    # something that cannot be exported.
    except Exception:
        return None
    return exported, outlines[0]


def _outline(made: Any) -> Any:
    """The containers about the arrays, as JSON has it.

    Raises:
        Unknown: another container.
    """
    if made is None:
        return None
    if isinstance(made, jax.Array):
        return "*"
    if isinstance(made, tuple) and hasattr(made, "_fields"):
        place = [type(made).__module__, type(made).__qualname__]
        if named(*place) is not type(made):
            raise Unknown(type(made))
        return {"record": place, "of": [_outline(v) for v in made]}
    if type(made) in (tuple, list):
        return {type(made).__name__: [_outline(v) for v in made]}
    if type(made) is dict and list(made) == sorted(made):
        return {"keys": list(made), "of": [_outline(v) for v in made.values()]}
    raise Unknown(type(made))


def _rebuilt(outline: Any, leaves: Any) -> Any:
    """What `_outline` was made of, with other arrays."""
    if outline is None:
        return None
    if outline == "*":
        return next(leaves)
    if "record" in outline:
        return named(*outline["record"])(*(_rebuilt(v, leaves) for v in outline["of"]))
    if "keys" in outline:
        values = [_rebuilt(v, leaves) for v in outline["of"]]
        return dict(zip(outline["keys"], values, strict=True))
    ((kind, parts),) = outline.items()
    made = [_rebuilt(v, leaves) for v in parts]
    return tuple(made) if kind == "tuple" else made


def _read(path: Path) -> tuple[jax.export.Exported, Any] | None:
    """What was kept; None where there is nothing, or nothing whole."""
    try:
        head, program = path.read_bytes().split(b"\n", 1)
        header = json.loads(head)
        if header["sha256"] != hashlib.sha256(program).hexdigest():
            return None
        return jax.export.deserialize(bytearray(program)), header["outline"]
    # A file that another program wrote there, or that a full disk cut off, is traced anew.
    except Exception:
        return None


def _write(path: Path, exported: jax.export.Exported, outline: Any) -> None:
    try:
        program = bytes(exported.serialize())
    # As it is traced: whatever has no place in a file is traced again by the next process.
    except Exception:
        return
    if len(program) > _LARGEST:
        return
    header = {"sha256": hashlib.sha256(program).hexdigest(), "outline": outline}
    # A disk that is full or not to be written costs the time of tracing, and nothing else.
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
            file.write(json.dumps(header).encode() + b"\n" + program)
        Path(file.name).replace(path)
        by_age = sorted(path.parent.iterdir(), key=lambda p: p.stat().st_mtime)
        for old in by_age[:-_MOST]:
            old.unlink(missing_ok=True)
