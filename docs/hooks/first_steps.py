"""What the commands of the first steps print, run in order when the site is built."""

import contextlib
import functools
import io
import os
import re
import shlex
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

_ROOT = Path(__file__).parents[2]
_LOG = (
    "heli-jax simulate configs/bench-roll.yaml --out first/bench.csv",
    "head -3 first/bench.csv",
    "heli-jax info first/bench.csv",
)
_NEW = (
    "heli-jax new first/bench.csv --model roll-on-stand "
    "--vehicle configs/vehicles/bench-30.yaml --out first/bench.yaml"
)
_CHECK = "heli-jax check first/bench.yaml"
_FIT = "heli-jax fit first/bench.yaml --out first/fit"
_EDIT = ("unit: m, scale: EDIT", "unit: um")
"""what the reader is told to replace, and by what"""
_COLUMNS = "100"


@functools.cache
def outputs() -> dict[str, str]:
    """By name of a part of the page the commands with what they print, and the configuration."""
    with _folder() as folder:
        parts = {
            "first-log": _console(*_LOG, first="$ source .venv/bin/activate\n"),
            "first-new": _console(_NEW),
        }
        path = folder / "first/bench.yaml"
        text = path.read_text(encoding="utf-8")
        parts["first-configuration"] = f"```yaml\n{text.strip()}\n```"
        parts["first-edit"] = _console(_CHECK, code=2)
        if text.count(_EDIT[0]) != 1:
            raise ValueError(f"docs/first-steps.md replaces {_EDIT[0]!r}, which `new` wrote not")
        path.write_text(text.replace(*_EDIT), encoding="utf-8")
        parts["first-check"] = _console(_CHECK)
        parts["first-fit"] = _console(_FIT)
    return parts


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """A new folder with the configurations, as the current one."""
    folder = Path(tempfile.mkdtemp(prefix="heli_jax-first-"))
    before = os.environ.get("COLUMNS")
    try:
        shutil.copytree(_ROOT / "configs", folder / "configs")
        (folder / "first").mkdir()
        os.environ["COLUMNS"] = _COLUMNS
        with contextlib.chdir(folder):
            yield folder
    finally:
        os.environ.pop("COLUMNS", None)
        if before is not None:
            os.environ["COLUMNS"] = before
        shutil.rmtree(folder)


def _console(*commands: str, first: str = "", code: int = 0) -> str:
    texts = [f"$ {command}\n{_printed(command, code)}" for command in commands]
    return f"```console\n{first}{''.join(texts)}```"


def _printed(command: str, code: int) -> str:
    """What a command says, on standard output and standard error."""
    from heli_jax.cli import main

    program, *words = shlex.split(command)
    if program == "head":
        lines = Path(words[1]).read_text(encoding="utf-8").splitlines(keepends=True)
        return "".join(lines[: -int(words[0])])
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        ended = main(words)
    if ended != code:
        raise ValueError(f"{command}: expected exit code {code}, got {ended}: {said.getvalue()}")
    # Tables begin and end with lines of spaces.
    return re.sub(r"[ ]+$", "", said.getvalue(), flags=re.MULTILINE)
