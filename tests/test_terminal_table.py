"""Tables on the terminal: no digit is cut at any width."""

import re
import sys

import pytest

from heli_jax import output
from heli_jax.identification.result import Estimate
from heli_jax.terminal_table import print_table, tell

HEAD = ("parameter", "estimate", "95 % (autocorrelated residuals)", "unit", "of another method")
ROWS = [
    ("Yv", "-0.1283", "-0.209123 to -0.046", "1/s", "-0.03900 (-0.03778 to -0.04023)"),
    ("sigma_w_p", "0.341", "0.310 to 0.375", "rad/s^2 [x]", "not determined"),
]


@pytest.mark.parametrize("width", [None, 120, 80, 50, 30])
def test_every_cell_is_whole_and_lines_fit(
    width: int | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if width is not None:
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    print_table(HEAD, ROWS)
    lines = re.sub(r"\x1b\[\d*m", "", capsys.readouterr().out).splitlines()
    for cell in (*HEAD, *ROWS[0], *ROWS[1]):
        assert any(cell in line for line in lines if cell != HEAD[0] or width != 30) or (
            cell == HEAD[0] and width == 30  # a list needs no name for its names
        )
    assert not any("…" in line for line in lines)
    if width is None:
        assert any("Yv" in line and "0.04023" in line for line in lines)
    elif width >= 50:
        assert max(map(len, lines)) <= width


def test_a_terminal_obeys_no_name(capsys: pytest.CaptureFixture[str]) -> None:
    name = "p\x1b[2J\x07\x9b1m\u202e\u2066\u200f\u2028\udcff\tq"
    tell(f"log {name}\nnext")
    print_table(("channel", name), [(name, "1")])
    out = capsys.readouterr().out
    assert out.startswith("log p?[2J??1m???")
    assert all(c.isprintable() for line in out.split("\n") for c in line)


@pytest.mark.parametrize("width", [None, 80, 50])
def test_sentences_begin_new_lines_between_words(
    width: int | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sentences = (
        "determined: a/Ixx = 215.3, sd 8.3, 95 % interval 199.75 to 232.1",
        "! x_roll to roll: bandwidth [rad/s] model 6.8 (6.24 to 7.43), 1.08 Hz, data not known",
        f"report: {'runs/' * 20}report.html",
    )
    if width is not None:
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    for sentence in sentences:
        tell(sentence)
    lines = capsys.readouterr().out.splitlines()
    assert " ".join(" ".join(lines).split()) == " ".join(sentences)
    if width is None:
        # A program that reads them finds each in a line of its own.
        assert lines == list(sentences)
    else:
        assert all(len(line) <= width or " " not in line.strip() for line in lines)


@pytest.mark.parametrize("width", [80, 50, 24])
def test_each_part_of_a_wide_table_has_all_columns_that_name_a_row(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    head = ("a.start", "Ixx.start", *(f"estimate {i}" for i in range(8)))
    rows = [(a, i, *(f"{a}{i}.{k}e-04" for k in range(8))) for a in ("4", "5") for i in ("1", "2")]
    print_table(head, rows, keys=2)
    text = re.sub(r"\x1b\[\d*m", "", capsys.readouterr().out)
    for line in text.splitlines():
        found = re.findall(r"([45])([12])\.\de-04", line)
        if found and width > 24:
            assert line.split()[:2] == list(found[0])
    for row in rows:
        assert all(cell in text for cell in row)
    assert max(map(len, text.splitlines())) <= width


def test_offsets_of_inputs_that_are_not_zero_are_shown_the_most_significant_first() -> None:
    def estimate(value: float) -> Estimate:
        return Estimate(value, 0.3, value - 0.6, value + 0.6, "V", 0.0, 0.0, at_bound=False)

    nuisance = {f"flight {i}/offset d": estimate(-0.2 * i) for i in range(8)}
    nuisance |= {"flight 1/bias p": estimate(5.0), "tau": estimate(0.0)}
    assert list(output._shown_nuisances(nuisance)) == [
        "tau", *(f"flight {i}/offset d" for i in (7, 6, 5, 4)),
    ]  # fmt: skip
