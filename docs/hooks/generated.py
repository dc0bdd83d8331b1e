"""Content that the site takes from the code when it is built, so that pages are never outdated.

A line `<!-- generated: NAME (WORDS) -->` is replaced by that content. NAME is an entry of `_PARTS`,
or `console`, which runs the block of commands below it and adds their output; exit codes have to
be 0, unless `$ echo $?` follows. WORDS are for readers of the file: where the content comes from.
The commands find a block with a title as a file. The demo's figures and report are added too; the
repository does not contain them.

With HELI_JAX_SITE=links nothing is simulated, fitted or run: blocks stay as they are, and empty
files replace the demo's, so that tests can follow every link within seconds.
"""

import contextlib
import functools
import io
import os
import re
import shutil
import string
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

_ROOT = Path(__file__).parents[2]
_LINKS_ALONE = os.environ.get("HELI_JAX_SITE") == "links"
_MARK = re.compile(
    r"^<!-- generated: (\S+)(?: \(.*\))? -->$(?:\n```console\n((?:.*\n)*?)```$)?", re.MULTILINE
)
_CONSOLE = re.compile(r"^<!-- generated: console .*-->$", re.MULTILINE)
_TITLED = re.compile(r'^```\w+ title="([\w.-]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)
_ENDS = re.compile(r"([|<>])")
_PAGE = re.compile(r"docs/([\w-]+)\.md")
# Of these the demo has the figures that the gallery shows; the report has all.
_DEMO = "configs/bench-roll.yaml"
_SWEEP = (
    "configs/bench-sweep.yaml",
    *("--set", "sweep.n=256", "--set", "simulate.duration=10", "--devices", "1"),
    *("--set", "sweep.reduce={rms_roll: {signal: roll, how: rms}}"),
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the demo's report and figures to the site, below made/."""
    made = _made()
    for path in sorted(made.rglob("*")):
        if path.suffix in (".svg", ".png", ".html", ".yaml", ".json", ".csv"):
            place = f"made/{path.relative_to(made).as_posix()}"
            files.append(File.generated(config, place, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return the page with its generated content."""
    if _LINKS_ALONE:
        markdown = _CONSOLE.sub("", markdown)
        markdown = re.sub(r"^```python exec=.*$", "```python", markdown, flags=re.MULTILINE)
    if not _CONSOLE.search(markdown):
        return _MARK.sub(lambda mark: _PARTS[mark[1]](), markdown)
    # A folder for each page, as `make demo` leaves it: its commands build on one another.
    with tempfile.TemporaryDirectory(prefix="heli_jax-page-") as folder:
        for part in ("configs", "runs"):
            shutil.copytree(_made() / part, Path(folder) / part)
        for name, text in _TITLED.findall(markdown):
            (Path(folder) / name).write_text(text, encoding="utf-8")
        return _MARK.sub(
            lambda m: _console(m[2], folder) if m[1] == "console" else _PARTS[m[1]](), markdown
        )


def _console(commands: str, folder: str) -> str:
    """The block with what each command prints, on standard output and standard error."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    lines, code = ["```console"], 0
    for command in commands.splitlines():
        lines.append(command)
        if command == "$ echo $?":
            lines.append(str(code))
            code = 0
            continue
        if code:
            break
        done = subprocess.run(
            ["bash", "-c", command.removeprefix("$ ")],
            cwd=folder, env=os.environ | {"PATH": path, "COLUMNS": "100"},
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        code = done.returncode
        # Tables begin and end with lines of spaces.
        lines += [line.rstrip() for line in done.stdout.splitlines()]
    if code:
        raise ValueError(f"exit code {code}, expected 0 or a line `$ echo $?`: {lines}")
    return "\n".join([*lines, "```"])


def on_shutdown(**_: Any) -> None:
    """Removes the demo's files."""
    if _made.cache_info().currsize:
        shutil.rmtree(_made())
        _made.cache_clear()


@functools.cache
def _made() -> Path:
    """The folder with what the demo and a small sweep wrote."""
    from heli_jax.cli import main

    folder = Path(tempfile.mkdtemp(prefix="heli_jax-site-"))
    if _LINKS_ALONE:
        for page in (_ROOT / "docs").rglob("*.md"):
            for name in re.findall(r"\]\((?:\.\./)?made/([^)#]+)", page.read_text("utf-8")):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).touch()
        (folder / "fit.txt").write_text("1\n2\n3\nacceptance card\n", encoding="utf-8")
        return folder
    shutil.copytree(_ROOT / "configs", folder / "configs")
    # Commands name files as they are told, and a page must not show where it was built.
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["simulate", _DEMO, "--out", "runs/demo/bench.csv"]) == 0
        assert main(["fit", _DEMO, "--verbose", "--out", "fit"]) == 0
        Path("fit.txt").write_text(printed.getvalue(), encoding="utf-8")
        assert main(["sweep", *_SWEEP, "--out", "sweep"]) == 0
    return folder


def _statements() -> str:
    """The three statements that the demo's fit begins with."""
    lines = (_made() / "fit.txt").read_text(encoding="utf-8").splitlines()
    return "\n".join(["```text", *lines[:3], "```"])


def _printed(begins: str) -> str:
    """The line of the demo's fit that begins so."""
    lines = (_made() / "fit.txt").read_text(encoding="utf-8").splitlines()
    return f"```text\n{next(line for line in lines if line.startswith(begins))}\n```"


def _table(head: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _cell(text: str) -> str:
    # A bar would end the cell, and Python-Markdown takes angle brackets for HTML.
    return _ENDS.sub(r"\\\1", text)


def _keys() -> str:
    from heli_jax.config.keys import keys
    from heli_jax.schema_keys import Key

    def entry(key: Key) -> str:
        default = "**has to be there**" if key.default is None else f"default `{key.default}`"
        default = "optional" if key.default == "null" else default
        # A list and not a table: paths are long, and screens may be narrow.
        words = _PAGE.sub(r"[\1](../\1.md)", _cell(key.meaning))
        meaning = f"<br>{words}" if words else ""
        return f"`{key.path}`\n:   {_cell(key.kind)}; {default}{meaning}"

    every, parts = keys(), []
    sections = dict.fromkeys(re.split(r"[.\[]", key.path)[0] for key in every)
    for section in sections:
        entries = (entry(k) for k in every if re.split(r"[.\[]", k.path)[0] == section)
        parts.append("\n\n".join((f"## {section}", *entries)))
    return "\n\n".join(parts)


def _fit_keys() -> str:
    from heli_jax.report.document import fit_keys
    from heli_jax.schema_keys import Key

    def entry(key: Key) -> str:
        words = f"<br>{_cell(key.meaning)}" if key.meaning else ""
        return f"`{key.path}`\n:   {_cell(key.kind)}{words}"

    return "\n\n".join(map(entry, fit_keys()))


def _commands() -> str:
    from heli_jax.cli import commands

    # Of the terminal in which the site is built nothing may show.
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "88"
    try:
        parser = commands._parser()
        [commands] = parser._subparsers._group_actions  # type: ignore[union-attr]
        texts = {name: command.format_help() for name, command in commands.choices.items()}  # type: ignore[union-attr]
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before
    return "\n\n".join(f"## {name}\n\n```text\n{text}```" for name, text in texts.items())


def _configurations() -> str:
    parts = []
    for path in sorted((_ROOT / "configs").rglob("*.yaml")):
        name = path.relative_to(_ROOT).as_posix()
        text = path.read_text(encoding="utf-8")
        parts.append(f"## {name} {{#{path.stem}}}\n\n```yaml\n{text}```")
    return "\n\n".join(parts)


def _findings() -> str:
    from heli_jax.messages import Message, messages

    def words(template: str) -> str:
        parts = []
        for text, field, kind, _ in string.Formatter().parse(template):
            kind = kind or ""
            name = "" if field is None or kind.startswith("?") else f"*{field}*"
            # A word for one or for several: that for several.
            shown = kind.partition("/")[2] or name
            parts += [_cell(text), shown]
        return "".join(parts)

    def entry(code: str, message: Message) -> str:
        lines = [f"{message.title}. {words(message.text)}", words(message.remedy)]
        lines += [f"Compared: {words(message.measure)}."] if message.measure else []
        lines += [f"[{message.page}](../{message.page}.md)"] if message.page else []
        return f"`{code}`\n:   {'<br>'.join(filter(None, lines))}"

    groups: dict[str, list[str]] = {}
    for code, message in messages().items():
        groups.setdefault(code.partition(".")[0], []).append(entry(code, message))
    return "\n\n".join("\n\n".join((f"## {g}", *entries)) for g, entries in groups.items())


def _models(linear: bool) -> str:
    from heli_jax import models

    def rows() -> Iterator[tuple[str, ...]]:
        for text, meaning in models.listed().items():
            model, name = models.by_text(text)
            if isinstance(name, dict) == linear:
                shown = f"{{linear: {name['linear']}}}" if isinstance(name, dict) else name
                records = (model.State, model.Inputs, model.Outputs)
                yield f"`{shown}`", _cell(meaning), *(_names(record) for record in records)

    return _table(("model", "meaning", "states", "inputs", "outputs"), rows())


def _names(record: type) -> str:
    from heli_jax import naming

    return " ".join(f"`{name}`" for name in naming.names(record))


def _symbols() -> str:
    """Parameters, inputs and outputs of the roll model on its stand and of the whole helicopter."""
    from heli_jax import models, naming

    records = (
        *(models.roll_on_stand.Params, models.by_name("helicopter").Params),
        *(models.roll_on_stand.Inputs, models.by_name("helicopter").Inputs),
        *(models.roll_on_stand.Outputs, models.by_name("helicopter").Outputs),
    )
    # Each name once, and as the first model that has it says.
    found = {n: r for r in reversed(records) for n in naming.names(r)}
    order = dict.fromkeys(n for r in records for n in naming.names(r))
    rows = (
        (f"`{n}`", naming.unit(found[n], n) or "", _cell(naming.meaning(found[n], n)))
        for n in order
    )
    return _table(("symbol", "unit", "meaning"), rows)


def _presets() -> str:
    from importlib import resources

    names = ("px4-helicopter", "ardupilot-helicopter", "rotorflight")
    folder = resources.files("heli_jax.flights").joinpath("presets")
    texts = (folder.joinpath(f"{n}.yaml").read_text(encoding="utf-8") for n in names)
    parts = (f"## {n}\n\n```yaml\n{t}```" for n, t in zip(names, texts, strict=True))
    return "\n\n".join(parts)


def _api() -> str:
    import heli_jax

    homes = heli_jax._HOMES
    placed = {n for names in _API.values() for n in names}
    further = tuple(n for n in homes if n not in placed)
    parts = []
    for heading, names in (_API | ({"Further": further} if further else {})).items():
        members = "\n\n".join(f"::: heli_jax.{homes[n]}.{n}" for n in names if n != "models")
        parts.append(f"## {heading}\n\n{members}")
    return "\n\n".join(parts)


_API = {
    "From a configuration": (
        *("load_config", "run_check", "run_fit", "FitRun", "compare_models", "run_sweep"),
        *("write_report", "load_fit", "SavedFit", "compare_runs"),
    ),
    "Flights": ("Flight", "Signal", "read_flight"),
    "Models and vehicles": (
        *("models", "Model", "LinearModel", "linear_model", "Helicopter", "load_vehicle"),
    ),
    "Simulation and analysis": (
        *("simulate", "SimulationOptions", "Trajectory", "accumulate", "trim", "linearize"),
        *("c2d", "d2c"),
    ),
    "Identification": (
        *("Problem", "Free", "Prior", "Nuisance", "check", "fit", "Fit", "intervals", "rls"),
    ),
    "Sweeps": ("sweep",),
}

_PARTS: dict[str, Callable[[], str]] = {
    "demo-statements": _statements,
    "demo-card": lambda: _printed("acceptance card"),
    "keys": _keys,
    "fit-keys": _fit_keys,
    "commands": _commands,
    "findings": _findings,
    "configurations": _configurations,
    "linear-models": lambda: _models(linear=True),
    "models": lambda: _models(linear=False),
    "symbols": _symbols,
    "presets": _presets,
    "api": _api,
}
