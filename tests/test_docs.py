"""Documentation site: links and anchors are valid, and nothing is loaded from the network.

`make docs` also runs the commands of the pages and stops at the first failure.
"""

import ast
import importlib
import os
import re
import shlex
import subprocess
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytest.importorskip("mkdocs", reason="the extra docs is not installed")
pytest.importorskip("material", reason="the extra docs is not installed")

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the site without running its commands; a broken link or anchor is an error."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        capture_output=True, text=True, cwd=ROOT, check=False,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1", "HELI_JAX_SITE": "links"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


class _Loaded(HTMLParser):
    """Return the addresses that a browser loads for a page, and its links."""

    def __init__(self):
        super().__init__()
        self.loaded, self.links, self.anchors = [], [], set()

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.anchors |= {values.get("id"), values.get("name")} - {None}
        if tag == "a":
            self.links.append(values.get("href") or "")
        elif tag == "link":
            self.loaded.append(values.get("href") or "")
        elif values.get("src"):
            self.loaded.append(values["src"])


@pytest.fixture(scope="module")
def pages(site):
    parsed = {}
    for path in sorted(site.rglob("*.html")):
        page = _Loaded()
        page.feed(path.read_text(encoding="utf-8"))
        parsed[path.relative_to(site).as_posix()] = page
    return parsed


def test_a_browser_loads_nothing_from_the_network(site, pages):
    assert len(pages) > 30
    for name, page in pages.items():
        assert [u for u in page.loaded if re.match(r"(?:\w+:)?//", u)] == [], name
    for sheet in site.rglob("*.css"):
        assert re.findall(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//[^)]*", sheet.read_text()) == []


def test_every_link_leads_somewhere(site, pages):
    # mkdocs checks Markdown only; this also checks the generated HTML.
    for name, page in pages.items():
        if name == "404.html":
            continue
        for link in page.links:
            target, _, anchor = link.partition("#")
            if re.match(r"\w+:", target):
                continue
            place = (site / name).parent / target if target else site / name
            place = place / "index.html" if place.is_dir() else place
            assert place.exists(), f"{name}: {link}"
            other = place.resolve().relative_to(site.resolve()).as_posix()
            if anchor and other in pages:
                assert anchor in pages[other].anchors, f"{name}: {link}"


def test_the_reference_has_what_the_code_has(site, pages):
    import heli_jax
    from heli_jax.config.keys import keys

    text = (site / "reference/keys.html").read_text(encoding="utf-8")
    assert [k.path for k in keys() if f"<code>{k.path}</code>" not in text] == []
    assert [k.path for k in keys() if not k.meaning] == []
    anchors = pages["reference/api.html"].anchors
    described = {a.rsplit(".", 1)[-1] for a in anchors}
    assert set(heli_jax.__all__) - described == {"models"}  # a module, described in words
    # Built pages do not contain the path of the build.
    assert str(ROOT) not in "".join(p.read_text() for p in site.rglob("*.html"))


PAGES = sorted((ROOT / "docs").rglob("*.md"))


def test_the_commands_of_the_pages_are_commands():
    """Test names and options of commands in the pages."""
    from heli_jax.cli import commands

    parser, count = commands._parser(), 0
    for page in PAGES:
        text = page.read_text("utf-8").replace("\\\n", " ")
        lines = re.findall(r"^ *(?:\$ )?heli-jax ([^:\n]*)$|`heli-jax ([^`]*)`", text, re.MULTILINE)
        for line in map("".join, lines):
            words = shlex.split(line.partition(" | ")[0].partition(" > ")[0], comments=True)
            # A command without options is a name in a sentence.
            if len(words) > 1 and not {"--help", "--version"} & {*words}:
                parser.parse_args(words)
                count += 1
    assert count > 60


def test_the_python_of_the_pages_imports_what_there_is():
    for page in PAGES:
        for block in re.findall(
            r"^```python[^\n]*\n(.*?)^```", page.read_text("utf-8"), re.S | re.M
        ):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and str(node.module).startswith("heli_jax"):
                    home = importlib.import_module(str(node.module))
                    assert [a.name for a in node.names if not hasattr(home, a.name)] == [], page


def test_every_extra_stands_in_the_table_of_extras():
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/index.md").read_text("utf-8"), re.MULTILINE)
    assert set(rows) == set(content["project"]["optional-dependencies"])


def test_the_gates_that_the_page_names_are_those_of_the_card():
    from heli_jax.report import card

    rows = [
        line.split("|")
        for line in (ROOT / "docs/reading-a-report.md").read_text(encoding="utf-8").splitlines()
        if line.startswith("|") and line.count("|") == 5
    ]
    asked = {row[1].strip(): row[2].strip() for row in rows}
    for what, limit in {
        "Cramér-Rao": f"at most {card.CRAMER_RAO:g} %",
        "insensitivity": f"at most {card.INSENSITIVITY:g} %",
        "largest correlation": f"at most {card.CORRELATION:g}",
        "VAF, NRMSE fit": f"at least {100 * card.VAF:g} %, at least {card.NRMSE_FIT:g} %",
        "Theil coefficient": f"at most {card.THEIL:g}",
        "Theil bias, variance part": f"at most {card.THEIL_PART:g}",
        "error power over expected": f"at most {card.EXPECTED:g}",
        "coherence": f"at least {card.COHERENCE:g}",
    }.items():
        assert limit in asked[what], what
