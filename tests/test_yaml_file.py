"""YAML files: conversion of plain data, and InputError for everything else."""

import math
import time

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from heli_jax.errors import InputError
from heli_jax.yaml_file import parse_mapping, parse_value, read_mapping


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-4", 1e-4),
        ("-1E+3", -1e3),
        ("1.", 1.0),
        (".5", 0.5),
        ("6.02e23", 6.02e23),
        ("0.1", 0.1),
        ("12", 12),
        ("-7", -7),
        ("0", 0),
        (".inf", math.inf),
        ("-.inf", -math.inf),
        ("true", True),
        ("False", False),
        ("null", None),
        ("~", None),
        ("", None),
        ("on", "on"),
        ("off", "off"),
        ("yes", "yes"),
        ("no", "no"),
        ("y", "y"),
        ("2024-01-02", "2024-01-02"),
        ("12:30:45", "12:30:45"),
        ("1_000", "1_000"),
        ("0x10", "0x10"),
        ("0o10", "0o10"),
        ("1e", "1e"),
        ("e4", "e4"),
        ("'1e-4'", "1e-4"),
        ("kg m^2", "kg m^2"),
        ("[1, 1e-4, on]", [1, 1e-4, "on"]),
    ],
)
def test_values(text, value):
    found = parse_value(text, "--set x")
    assert type(found) is type(value)
    assert found == value


def test_mapping_of_mappings(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("\ufeffa: {b: 1e-4, c: [on, 2]}\n# comment\nd: µ\n", encoding="utf-8")
    assert read_mapping(path) == {"a": {"b": 1e-4, "c": ["on", 2]}, "d": "µ"}
    assert read_mapping(str(path)) == read_mapping(path)


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)
WRONG = {
    "a key twice": ("a: 1\nb: 2\na: 3\n", "line 3"),
    "a key twice inside": ("a:\n  b: 1\n  b: 2\n", "line 3"),
    "aliases that blow up": (BOMB, "line [0-9]+"),
    "recursive alias": ("a: &x [*x]\n", "line 1"),
    "recursive mapping": ("a: &x\n  b: *x\n", "line [12]"),
    "recursive key": ("&x {*x : 1}", ""),
    "deep lists": ("[" * 100_000, ""),
    "deep mappings": ("{a: " * 100_000, ""),
    "deep and closed": ("a: " + "[" * 5_000 + "]" * 5_000, ""),
    "deep by dashes": ("- " * 50_000 + "x", ""),
    "deep by indents": ("\n".join(" " * i + "a:" for i in range(500)), ""),
    "python object": ("a: 1\nb: !!python/object/apply:os.system [ls]\n", "line 2"),
    "python name": ("a: !!python/name:os.system\n", "line 1"),
    "unknown tag": ("a: !thing 3\n", "line 1"),
    "a tab": ("a:\n\tb: 1\n", "line 2"),
    "unclosed": ("a: [1, 2\nb: 3\n", "line [12]"),
    "unclosed quote": ("a: 'x\n", "line [123]"),
    "two documents": ("a: 1\n---\nb: 2\n", "line [123]"),
    "undefined alias": ("a: *nothing\n", "line 1"),
    "empty": ("", ""),
    "comment alone": ("# nothing here\n", ""),
    "list at top": ("- a\n- b\n", ""),
    "number at top": ("3\n", ""),
    "text at top": ("hello\n", ""),
    "a key that is a list": ("[1, 2]: 3\n", "line 1"),
    "a control character": ("a: \x07\n", ""),
    "NUL": ("a: \x00\n", ""),
    "wrong int tag": ("a: !!int x\n", ""),
    "wrong float tag": ("a: !!float x\n", ""),
    "wrong bool tag": ("a: !!bool x\n", ""),
    "wrong timestamp tag": ("a: !!timestamp x\n", ""),
    "wrong set tag": ("a: !!set x\n", ""),
    "wrong map tag": ("a: !!map x\n", ""),
    "wrong pairs tag": ("a: !!pairs [1, 2]\n", ""),
    "wrong binary tag": ("a: !!binary é\n", ""),
    "merge of a number": ("a: {<<: 3}\n", ""),
    "percent directive": ("%YAML 9.9\n---\na: 1\n", ""),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said_in_one_line(case, tmp_path):
    text, said = WRONG[case]
    path = tmp_path / "f.yaml"
    path.write_text(text, encoding="utf-8")
    begin = time.process_time()
    with pytest.raises(InputError, match=said or None) as e:
        read_mapping(path)
    assert time.process_time() - begin < 5.0
    assert str(e.value).startswith(str(path))
    assert "\n" not in str(e.value)
    assert len(str(e.value)) < len(str(path)) + 300


def test_nothing_runs(tmp_path):
    path, made = tmp_path / "f.yaml", tmp_path / "made"
    path.write_text(f"a: !!python/object/apply:os.mkdir ['{made}']\n")
    with pytest.raises(InputError):
        read_mapping(path)
    assert not made.exists()


@pytest.mark.parametrize(
    "content", [b"\xff\xfe\x00\x01\x02", bytes(range(256)) * 10, b"a: 1\n" * 300_000]
)
def test_files_that_are_no_text(content, tmp_path):
    path = tmp_path / "f.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_mapping(path)


def test_no_file_and_folder(tmp_path):
    (tmp_path / "f").write_text("x")
    for path in (tmp_path / "none.yaml", tmp_path, tmp_path / "f" / "under.yaml"):
        with pytest.raises(InputError):
            read_mapping(path)


def mapping_or_error(read):
    """Return the content read, or the message of the refusal."""
    try:
        return read(), ""
    except InputError as e:
        return None, str(e)


yamlish = st.text(st.sampled_from(list("ab1-:?,[]{}&*!|>'\"%@` #\n\t.<~eé\x00\x85")), max_size=40)


@given(st.one_of(st.text(max_size=60), yamlish))
@example("? - a\n  - b\n: c")
@example("a: !!timestamp 2024-13-45")
@example("a: !!int ''")
@example("a: !!float ''")
@example("a: !!float '1:2:3'")
@example("<<: [1]")
@example("{<<: {a: 1}, <<: {b: 2}}")
@example("a: !!int 9" + "9" * 5000)
@example("9" * 5000)
@example("a: !!str {}")
@example("!!map [")
@example("a: !!omap [{}]")
@example("a: 1\ud800")
def test_no_text_raises_anything_but_input_error(text):
    found, said = mapping_or_error(lambda: parse_mapping(text, "here"))
    assert isinstance(found, dict) or (said.startswith("here") and "\n" not in said)


@given(st.binary(max_size=60))
def test_no_bytes_raise_anything_but_input_error(content):
    import tempfile

    with tempfile.NamedTemporaryFile(suffix=".yaml") as f:
        f.write(content)
        f.flush()
        found, said = mapping_or_error(lambda: read_mapping(f.name))
    assert isinstance(found, dict) or (said.startswith(f.name) and "\n" not in said)


names = st.from_regex(r"[a-z][a-z_]{0,8}", fullmatch=True).filter(
    lambda s: s not in ("null", "true", "false")
)
finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.dictionaries(names, st.one_of(finite, st.integers(-(10**15), 10**15), names)))
def test_what_python_writes_comes_back(content):
    text = "{" + ", ".join(f"{k}: {v}" for k, v in content.items()) + "}"
    assert parse_mapping(text, "here") == content
