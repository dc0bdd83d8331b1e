"""Numbers on pages and on the terminal: one rule for digits and rounding."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from heli_jax import numbers

VALUES = st.floats(1e-12, 1e12) | st.floats(-1e12, -1e-12) | st.just(0.0)


def value_of(text):
    """Return the number shown on a page, computed without the code under test."""
    digits, _, power = text.replace("−", "-").partition("·10")
    raised = "".join("-0123456789"["⁻⁰¹²³⁴⁵⁶⁷⁸⁹".index(c)] for c in power) or "0"
    return float(f"{digits}e{raised}")


def digits_of(text):
    return re.sub(r"e.*|[^0-9]", "", text.partition("·")[0]).lstrip("0")


@given(VALUES, st.integers(1, 9))
def test_terminal_and_page_write_the_same_number(value, digits):
    page, terminal = numbers.number(value, digits), numbers.terse(value, digits)
    assert terminal.isascii()
    assert float(terminal) == value_of(page)
    assert digits_of(terminal) == digits_of(page)


@given(VALUES, st.floats(1e-12, 1e12))
def test_terminal_and_page_round_to_the_same_digit_of_the_standard_deviation(value, sd):
    for page, terminal in zip(numbers.measured(sd, value), numbers.rounded(value, sd), strict=True):
        assert terminal.isascii()
        assert float(terminal) == value_of(page)
        assert digits_of(terminal) == digits_of(page)


@pytest.mark.parametrize(
    ("value", "page", "terminal"),
    [
        (7.5e-6, "7.5·10⁻⁶", "7.5e-06"),
        (5e-324, "4.941·10⁻³²⁴", "4.941e-324"),
        (-1.25e7, "−1.25·10⁷", "-1.25e+07"),
        (0.0123, "0.0123", "0.0123"),
        (0.0032, "0.0032", "0.0032"),
        (0.00032, "3.2·10⁻⁴", "3.2e-04"),
        (31400.0, "31400", "31400"),
        (float("inf"), "∞", "inf"),
        (-float("inf"), "−∞", "-inf"),
        (None, "–", "-"),
    ],
)
def test_powers_stand_as_python_writes_them(value, page, terminal):
    assert numbers.number(value) == page
    assert numbers.terse(value) == terminal


@pytest.mark.parametrize(
    ("python", "page", "terminal"),
    [
        ("rms error 3.2e-03 rad", "rms error 0.0032 rad", "rms error 0.0032 rad"),
        ("1.2e+02 % (-7.5e-06)", "120 % (−7.5·10⁻⁶)", "120 % (-7.5e-06)"),
        ("factor 1.5e+04, +2e+00", "factor 15000, +2", "factor 15000, +2"),
        ("at 2.50e+07.", "at 2.50·10⁷.", "at 2.50e+07."),
        # Numbers written by a user, and texts that are not numbers.
        ("got '1e3' in runs/1e-03/fit.json", "got '1e3' in runs/1e-03/fit.json", None),
        ("1e-03.csv has a 0x1e3 and a-1e3", "1e-03.csv has a 0x1e3 and a-1e3", None),
    ],
)
def test_exponents_within_a_sentence_are_written_by_the_same_rule(python, page, terminal):
    assert numbers.page_sentence(python) == page
    assert numbers.terminal_sentence(python) == (terminal or page)


def test_what_is_rounded_up_to_a_power_has_that_power():
    assert numbers.number(0.00099996, 3) == "0.001"
    assert numbers.number(99999.7, 3) == "1·10⁵"


def test_a_chance_has_no_digits_where_it_is_none_to_speak_of():
    assert [numbers.p_value(p) for p in (0.0, 1e-200, 0.0123)] == ["below 1e-6"] * 2 + ["0.012"]
