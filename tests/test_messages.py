"""Messages: every finding has a text, and every text has a finding."""

import ast
import re
import string
from pathlib import Path

import pytest

import heli_jax
from heli_jax.identification.restarts import RESTARTS
from heli_jax.messages import listed, messages, written

ROOT = Path(heli_jax.__file__).parent
CODE = re.compile(r"[a-z][a-z-]+\.[a-z][a-z0-9-]+")


def strings():
    """Return all text constants of the package that may be a code."""
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            text = node.value if isinstance(node, ast.Constant) else None
            if isinstance(text, str) and CODE.fullmatch(text):
                yield text


def codes_found():
    """Return the codes passed to `found(...)` and `sentence(...)`."""
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            called = node.func if isinstance(node, ast.Call) else None
            if isinstance(called, ast.Name) and called.id in ("found", "sentence") and node.args:
                inside = ast.walk(node.args[0])
                texts = (n.value for n in inside if isinstance(n, ast.Constant))
                yield from (t for t in texts if isinstance(t, str))


def test_each_code_has_words_and_all_words_have_a_code():
    assert {c for c in codes_found() if CODE.fullmatch(c)} <= messages().keys()
    restarts = {f"search.{restart.name}" for restart in RESTARTS}
    assert restarts <= messages().keys() <= {*strings(), *restarts}


@pytest.mark.parametrize("code", sorted(messages()))
def test_words_are_sentences_of_a_known_page(code):
    message = messages()[code]
    assert message.title
    assert message.text
    assert not message.page or (ROOT.parent / "docs" / f"{message.page}.md").is_file()
    for text in (message.text, message.remedy):
        list(string.Formatter().parse(text))
        assert not text or text[-1] in ".}"


def test_what_fields_can_say():
    assert listed(["a", "b", "c"], "or") == "a, b or c"
    numbers = {"p": 1e-9, "names": ["u", "v"], "vaf": -30.0, "lead": "", "by": "0.1 s", "n": 1}
    assert written("{p:p}", numbers) == "below 1e-6"
    assert written("{names} {names:moves/move}, {names:or}", numbers) == "u and v move, u or v"
    assert written("x{lead:? (* earlier)}{by:? (* earlier)}", numbers) == "x (0.1 s earlier)"
    assert written("{n} {n:step/steps}", numbers) == "1 step"
    assert written("{vaf:vaf}", numbers) == "below -1000 %"
