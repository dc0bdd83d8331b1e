"""Units against the definitions of SI, not against the package's table."""

import math
import re
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from heli_jax import units

FACTORS = [
    ("mm", "m", 1e-3),
    ("km", "m", 1e3),
    ("in", "m", 0.0254),
    ("ms", "s", 1e-3),
    ("us", "s", 1e-6),
    ("deg", "rad", math.pi / 180.0),
    ("rev", "rad", 2.0 * math.pi),
    ("rpm", "rad/s", 2.0 * math.pi / 60.0),
    ("Hz", "rad/s", 2.0 * math.pi),
    ("deg/s^2", "rad/s^2", math.pi / 180.0),
    ("1/deg", "1/rad", 180.0 / math.pi),
    ("g", "kg", 1e-3),
    ("g cm^2", "kg m^2", 1e-7),
    ("g·cm^2", "kg m^2", 1e-7),
    ("kg mm^2", "kg m^2", 1e-6),
    # Spellings of logs and NetCDF attributes.
    *((u, "rad/s", math.pi / 180.0) for u in ("deg s-1", "degrees_per_second", "deg_s", "dps")),
    *((u, "rad/s", math.pi / 180.0) for u in ("deg_per_s", "degree/second", "Grad/s", "°·s⁻¹")),
    *((u, "m/s^2", 1.0) for u in ("m s-2", "m.s-2", "m/s²", "m/s2", "m_s2")),
    ("km/h", "m/s", 1.0 / 3.6),
    ("N mm", "N m", 1e-3),
    ("%", "1", 1e-2),
    ("percent", "1", 1e-2),
    ("stick", "1", 1.0),
    ("gee", "m/s^2", 9.80665),
    ("1/ms^2", "1/s^2", 1e6),
    ("lbf", "N", 4.4482216152605),
    ("kt", "m/s", 1852.0 / 3600.0),
    ("mi/h", "m/s", 1609.344 / 3600.0),
    ("mN m/A", "N m/A", 1e-3),
    ("V s/rad", "N m s/A/s/rad", 1.0),
    ("ohm", "V/A", 1.0),
    ("kilometers", "m", 1e3),
    ("", "1", 1.0),
    ("-", "1", 1.0),
    # A plain number counts as radians, as in SI.
    ("1/s", "rad/s", 1.0),
    ("1", "rad", 1.0),
    ("1", "1/rad", 1.0),
    ("1/min", "1/s", 1.0 / 60.0),
    ("U/min", "rad/s", 2.0 * math.pi / 60.0),
    ("grad/s", "rad/s", math.pi / 180.0),
]


@pytest.mark.parametrize(("unit", "si", "wanted"), FACTORS)
def test_factors(unit, si, wanted):
    assert units.factor(unit, si) == pytest.approx(wanted, rel=1e-13)


@pytest.mark.parametrize(
    ("unit", "si"),
    [
        ("mm", "rad"),
        ("kg", "kg m^2"),
        ("deg", "rad/s"),
        ("%", "m"),
        # SI allows the reverse; here a Hz could pass for 1/s.
        ("Hz", "1/s"),
        # Benches write turns like this; radians per minute are 6.28 times as many.
        ("1/min", "rad/s"),
        ("min-1", "rad/s"),
        ("1/h", "rad/s"),
        ("N m/quux", "N m/A"),
        # Their zero differs from that of K.
        ("degC", "K"),
    ],
)
def test_another_kind_is_refused(unit, si):
    with pytest.raises(ValueError, match=re.escape(unit)):
        units.factor(unit, si)


@pytest.mark.parametrize(
    ("unit", "near"),
    [("Deg", "deg"), ("radd", "rad"), ("RPM", "rpm"), ("mmm", "mm"), ("rads", "rad/s")],
)
def test_unknown_unit_names_the_nearest(unit, near):
    with pytest.raises(ValueError, match=f"'{unit}'.*'{near}'"):
        units.factor(unit, "rad")


def test_every_unit_that_the_docs_list_is_known():
    text = (Path(__file__).parents[1] / "docs/units.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("|")]
    named = {name for row in rows for name in re.findall(r"`([^`]*)`", row)}
    assert len(named) > 30
    for name in named:
        units.base_of(name)
    assert units.base_of("V") == {"kg": 1, "m": 2, "s": -3, "A": -1}
    assert units.si_of("mV") == "V"


def test_unit_of_a_product_of_powers():
    si = {"a": "1/rad", "Ixx": "kg m^2", "Lb": "1/s^2", "tau": "s"}
    assert units.base_of(units.of_product(si, {"a": 1.0, "Ixx": -1.0})) == {
        "kg": -1,
        "m": -2,
        "rad": -1,
    }
    assert units.of_product(si, {"Lb": 1.0, "tau": 2.0}) == "1"
    assert units.of_product(si, {"Lb": 0.5, "tau": 2.0}) == "s"
    assert units.of_product(si, {"tau": 0.3}) == ""


HOSTILE = [
    "9**9**9**9",
    "m**9**9**9**9",
    "m^99999999",
    "10^10^10",
    '__import__("os")',
    "().__class__",
    "m" * 1_000_000,
    "m*" * 500_000,
    " " * 1_000_000 + "!",
    "m " * 29 + "!",
    "nan",
    "inf",
    "(" * 10_000,
    "m/0",
    "0",
    "2",
    "1e400",
    "m;s",
    "\x00",
    "ммм",
    "{unit}",
    "m + m",
]


@pytest.mark.parametrize("unit", HOSTILE, ids=[f"{u[:12]!r}" for u in HOSTILE])
def test_hostile_text_is_refused_fast_and_in_one_short_line(unit):
    begin = time.process_time()
    with pytest.raises(ValueError, match="unknown unit") as e:
        units.factor(unit, "rad/s^2")
    assert time.process_time() - begin < 1.0
    assert len(str(e.value)) < 300
    assert "\n" not in str(e.value)


@given(st.text(max_size=70))
def test_no_text_raises_anything_but_value_error(text):
    try:
        number = units.factor(text, "rad")
    except ValueError:
        return
    assert math.isfinite(number)
    assert number > 0


prefixed = st.builds(
    str.__add__, st.sampled_from(["", "m", "k", "c"]), st.sampled_from(["m", "s", "g", "rad", "N"])
)
powered = st.builds(lambda u, n: f"{u}^{n}", prefixed, st.integers(1, 4))
compound = st.builds(
    lambda a, op, b: a + op + b, powered, st.sampled_from(["*", "/", " "]), powered
)


@given(compound)
def test_factor_is_positive_and_inverts(unit):
    try:
        si = units.si_of(unit)
    except ValueError:  # a kind without a listed SI unit is compared with itself
        si = unit
    assert units.factor(unit, si) * units.factor(si, unit) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "si"),
    [("deg", "rad"), ("rpm", "rad/s"), ("Hz", "rad/s"), ("mm", "m"), ("%", "1"), ("g", "kg")],
)
def test_si_of(unit, si):
    assert units.si_of(unit) == si


def test_units_are_written_with_newton_and_volt_where_that_is_shorter():
    for text in ("rad/s^2/V", "N m/rad", "V s", "kg m^2", "kg/m^3", "1/s^2", "A", "N/V", "V/A"):
        assert units.as_text(units.base_of(text)) == text
