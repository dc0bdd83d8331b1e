"""What made a page: the command, when, and the configuration; and the files beside the page."""

import shlex
import sys
from datetime import datetime
from pathlib import Path
from typing import NamedTuple


class Origin(NamedTuple):
    """Where a page came from."""

    command: str
    date: str
    """with its offset from UTC"""
    config: str = ""
    """the configuration in full, as YAML"""
    files: tuple[str, ...] = ()
    """beside the page, by their names relative to it"""


def origin(config: str = "", files: tuple[str, ...] = ()) -> Origin:
    """Of a page that this process makes now.

    Args:
        config: the configuration in full, as YAML.
        files: beside the page, by their names relative to it.
    """
    # The program by its name alone: where it is installed is nobody's business.
    words = [Path(sys.argv[0]).name or "python", *sys.argv[1:]] if sys.argv else ["python"]
    now = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    return Origin(shlex.join(words), now, config, files)
