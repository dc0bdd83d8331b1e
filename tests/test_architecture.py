"""docs/architecture.md names files; each exists."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_file_that_the_architecture_names_exists():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:heli_jax|tests|docs)/[\w/.]*)`", text))
    assert len(named) > 30
    assert sorted(name for name in named if not (ROOT / name).exists()) == []


def test_it_stays_short():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 170
