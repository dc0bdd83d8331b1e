"""Directory of a study; each fit's own directory appears complete or not at all."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

from heli_jax import run_directory
from heli_jax.config.study import Study
from heli_jax.errors import InputError
from heli_jax.regular_file import read_regular
from heli_jax.studies.point import Outcome
from heli_jax.sweeps import description
from heli_jax.yaml_file import as_yaml

FITS = "fits"
_DESCRIPTION = "study.json"
_LONGEST_NAME = 80
_LIMIT_BYTES = 1_000_000_000


def create(out: Path, study: Study, described: dict[str, Any], versions: dict[str, str]) -> None:
    """Make a new directory without fits; it appears complete or not at all.

    Raises:
        InputError: it cannot be written to.
    """
    with run_directory.whole(out) as folder:
        text = as_yaml({**study.content, "study": described["axes"]})
        place = f"# Relative paths in it begin at {study.path.absolute().parent}.\n"
        (folder / "study.yaml").write_text(place + text, encoding="utf-8")
        content = {**described, "versions": versions}
        (folder / _DESCRIPTION).write_text(json.dumps(content, indent=1), encoding="utf-8")
        (folder / FITS).mkdir()


def require_same(out: Path, described: dict[str, Any]) -> dict[str, str]:
    """Refuse the directory of another study; return the versions of its first run.

    Raises:
        InputError: it belongs to another study, or to none.
    """
    where = f"--out {out}"
    data = read_regular(out / _DESCRIPTION, "the study.json of a study", _LIMIT_BYTES)
    try:
        old = json.loads(data)
        versions = old.pop("versions")
    except (ValueError, KeyError, AttributeError, TypeError) as e:
        raise InputError(f"{where}: {_DESCRIPTION} is not what a study writes ({e})") from e
    description.require_same(old, described, f"{where}: is of another study")
    return versions


def names(study: Study) -> list[str]:
    """Return the directories of the fits: a number and the values that differ."""
    short = _short_keys(list(study.axes))
    width = len(str(study.size - 1))
    named = []
    for i, point in enumerate(study.points()):
        words = "_".join(f"{short[key]}={_word(value)}" for key, value in point.items())
        named.append(f"{i:0{width}d}_{words}"[:_LONGEST_NAME].rstrip("._-"))
    return named


def _short_keys(keys: list[str]) -> dict[str, str]:
    """Return the shortest unique ends of keys; `Ixx` for its start."""
    # In `fit.free.Ixx.start` the last word is less specific than the one before.
    parts = {key: key.removesuffix(".start").split(".") for key in keys}
    for depth in range(1, max(len(p) for p in parts.values()) + 1):
        short = {key: ".".join(p[-depth:]) for key, p in parts.items()}
        if len(set(short.values())) == len(keys):
            return short
    return {key: key for key in keys}


# Any: content of YAML.
def _word(value: Any) -> str:
    text = Path(value).stem if isinstance(value, str) else json.dumps(value)
    return re.sub(r"[^\w.+]+", "-", text).strip("-")


def read_fit(place: Path) -> dict[str, Any] | None:
    """Return the content of fit.json or failed.json in a fit's directory; None if there is neither.

    Raises:
        InputError: it cannot be read.
    """
    for name in ("fit.json", "failed.json"):
        path = place / name
        if path.exists():
            data = read_regular(path, f"the {name} of a fit", _LIMIT_BYTES)
            try:
                content = json.loads(data)
            except ValueError as e:
                raise InputError(f"{path}: expected JSON, got {str(e)[:80]}") from e
            if not isinstance(content, dict):
                raise InputError(f"{path}: expected a JSON object")
            return content
    return None


def write_fit(place: Path, outcome: Outcome) -> None:
    """Write a fit's directory; it replaces that of a failed fit.

    Raises:
        InputError: it cannot be written.
    """
    shutil.rmtree(place, ignore_errors=True)
    with run_directory.whole(place) as folder:
        for name, data in outcome.files.items():
            file = folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)


def remove_remains(out: Path) -> None:
    """Remove unfinished files of a killed process; only for the holder of the lock."""
    for folder in (out, out / FITS):
        for path in folder.glob(".*-????????"):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
