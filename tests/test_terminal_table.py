"""Tables on the terminal: digits are never cut, at any width."""

import re
import sys

import pytest

from heli_jax.cli import fits as output
from heli_jax.cli.terminal import print_table, print_text
from heli_jax.identification.result import Estimate

HEAD = ("parameter", "estimate", "95 % (autocorrelated residuals)", "unit", "of another method")
ROWS = [
    ("Yv", "-0.1283", "-0.209123 to -0.046", "1/s", "-0.03900 (-0.03778 to -0.04023)"),
    ("sigma_w_p", "0.341", "0.310 to 0.375", "rad/s^2 [x]", "not determined"),
]


@pytest.mark.parametrize("width", [None, 120, 50])
def test_every_cell_is_whole(
    width: int | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if width is not None:
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    print_table(HEAD, ROWS, keys=2)
    lines = re.sub(r"\x1b\[\d*m", "", capsys.readouterr().out).splitlines()
    for cell in (*HEAD[2:], *ROWS[0], *ROWS[1]):
        assert any(cell in line for line in lines)
    assert any("Yv" in line and "0.04023" in line for line in lines) == (width != 50)


def test_a_terminal_obeys_no_name(capsys: pytest.CaptureFixture[str]) -> None:
    name = "p\x1b[2J\x07\x9b1m\u202e\u2066\u200f\u2028\udcff\tq"
    print_text(f"log {name}\nnext")
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
        print_text(sentence)
    lines = capsys.readouterr().out.splitlines()
    assert " ".join(" ".join(lines).split()) == " ".join(sentences)
    if width is None:
        # A program that reads them gets one line each.
        assert lines == list(sentences)
    else:
        assert all(len(line) <= width or " " not in line.strip() for line in lines)


def test_offsets_of_inputs_that_are_not_zero_are_shown_the_most_significant_first() -> None:
    def estimate(value: float) -> Estimate:
        return Estimate(value, 0.3, value - 0.6, value + 0.6, "V", 0.0, 0.0, at_bound=False)

    nuisance = {f"flight {i}/offset d": estimate(-0.2 * i) for i in range(8)}
    nuisance |= {"flight 1/bias p": estimate(5.0), "tau": estimate(0.0)}
    assert list(output._shown_nuisances(nuisance)) == [
        "tau", *(f"flight {i}/offset d" for i in (7, 6, 5, 4)),
    ]  # fmt: skip
