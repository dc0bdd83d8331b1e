"""Plain words: docstrings, messages and pages use the field's terms and short sentences.

The rules are few and mechanical; they do not replace reading.
"""

import ast
import re
import string
from collections.abc import Iterator
from pathlib import Path

import pytest

import heli_jax
from heli_jax.messages import messages

ROOT = Path(heli_jax.__file__).parent
BEGINNINGS = re.compile(r"(?:Of|What|Whether|That|Where|How|Which|Those|Why|When)\b")
DIALECT = re.compile(
    r"\b(?:machines?(?! code)|arrived|foretells?|foretold|hangs? together|bears? \w+ out|told apart"
    r"|tells? \w+ apart|answers? alike|memory of residuals|no parabola|unbent|deaf|mend)\b",
    re.IGNORECASE,
)
COMPUTERS = re.compile(
    r"(?:this|another) machine|more machines|of the machine, and whoever|a machine's memory"
)
LONGEST_MESSAGE, LONGEST = 30, 35


def docstrings() -> Iterator[tuple[str, str]]:
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            named = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            if named and (text := ast.get_docstring(node)):
                yield f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}", text


def prose(page: Path) -> Iterator[str]:
    """Yield paragraphs, items and cells of a page, without headings and with code replaced."""
    text = page.read_text("utf-8")
    text = re.sub(r"^ *```.*?^ *```|<!--.*?-->", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^(?:    |#).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"(?:`[^`]*`,? )*`[^`]*`", "code", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text).replace("**", "")
    for part in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) |\|", text):
        yield " ".join(part.split())


def sentences(text: str) -> list[str]:
    return re.split(r"(?<=[.!?;])\s+", text)


def test_docstrings_begin_with_a_noun_an_imperative_or_true_if():
    assert [place for place, text in docstrings() if BEGINNINGS.match(text)] == []
    plain = ((place, COMPUTERS.sub("", text)) for place, text in docstrings())
    assert [f"{place}: {m[0]}" for place, text in plain if (m := DIALECT.search(text))] == []


@pytest.mark.parametrize("code", sorted(messages()))
def test_a_message_has_short_sentences(code):
    message = messages()[code]
    for template in (message.title, message.text, message.remedy, message.brief, message.measure):
        plain = "".join(t + ("N" if f else "") for t, f, _, _ in string.Formatter().parse(template))
        assert not BEGINNINGS.match(plain)
        assert not DIALECT.search(template)
        assert [s for s in sentences(plain) if len(s.split()) > LONGEST_MESSAGE] == []


@pytest.mark.parametrize("page", sorted((ROOT.parent / "docs").rglob("*.md")), ids=lambda p: p.stem)
def test_a_page_has_short_sentences_and_the_fields_words(page):
    for part in prose(page):
        assert not DIALECT.search(COMPUTERS.sub("", part)), part
        assert [s for s in sentences(part) if len(s.split()) > LONGEST] == []
