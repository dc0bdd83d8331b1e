"""Vehicle files: shipped numbers, and errors for wrong files."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heli_jax import Helicopter, load_vehicle, naming
from heli_jax.errors import InputError
from heli_jax.vehicle import read_vehicle, vehicle_from_mapping
from tests.dynamics import paper, whole_helicopter

# Copied by hand from the paper and its reading.
BENCH_30 = {n: v for n, v in paper.BENCH.items() if n not in ("kappa", "zeta")}
STAND = {"kappa": 4.0, "zeta": 0.2}
# The paper's tip loss and the 1/2 of eqs 14-15.
SAME = {"B": 0.97, "cyclic_moment": 0.5, "Ixx_added": 0.0, "Iyy_added": 0.0, "K_mu": 1.0}
# Gavrilets' X-Cell .60: rotor inertia, tail height and governor.
ROTOR = {"k_beta": 54.0, "I_beta": 0.038, "h_T": 0.08, "K_P": 0.01, "K_I": 0.02, "Omega": 157.1}


@pytest.mark.parametrize(
    ("file", "wanted"),
    [
        ("bench-30.yaml", {**BENCH_30, **STAND, "Sx": 0.0, "Sy": 0.0, "Sz": 0.0, "h_T": 0.0}),
        ("x-cell-60.yaml", {**whole_helicopter.XCELL, **ROTOR, "kappa": 0.0, "zeta": 0.0}),
    ],
)
def test_shipped_vehicles(file, wanted, vehicles_folder):
    found, wanted = naming.asdict(load_vehicle(vehicles_folder / file)), wanted | SAME
    assert {n: float(found[n]) for n in wanted} == wanted
    for name in set(found) - set(wanted) - {"g", "rho"}:
        assert math.isnan(float(found[name])), name


@pytest.mark.parametrize("file", ["bench-30.yaml", "x-cell-60.yaml", "t-rex-550.yaml"])
def test_every_shipped_number_says_where_it_is_from(file, vehicles_folder):
    read = read_vehicle(vehicles_folder / file)
    for name, constant in read.constants.items():
        assert constant.source, name
        assert constant.unit == naming.unit(Helicopter, name)
        assert constant.value == float(getattr(read.params, name))
    assert read.path == str(vehicles_folder / file)


def test_hover_of_the_x_cell_balances(vehicles_folder):
    # reading.md: "Hover (X-Cell numbers): C_T 0.004125, ..., vi 4.89 m/s". K_theta0 and similar
    # constants follow from it. Momentum theory: T = 2 rho A vi^2.
    v = load_vehicle(vehicles_folder / "x-cell-60.yaml")
    thrust, area = float(v.m * v.g), math.pi * float(v.R) ** 2
    pressure = float(v.rho) * area
    assert math.sqrt(thrust / (2.0 * pressure)) == pytest.approx(4.89, abs=0.01)
    assert thrust / (pressure * float(v.R * v.Omega) ** 2) == pytest.approx(0.004125, rel=1e-3)
    # The motor's torque turns the rotor, so K_Tm = Ir K_throttle.
    assert float(v.K_Tm) == pytest.approx(float(v.Ir * v.K_throttle), rel=1e-3)


def test_every_field_has_a_unit_and_a_meaning():
    for name in naming.names(Helicopter):
        assert naming.unit(Helicopter, name), name
        assert naming.meaning(Helicopter, name), name


def read(**changes):
    """Return the bench vehicle with some entries changed; None removes one."""
    content = {**BENCH_30, **changes}
    return vehicle_from_mapping({k: v for k, v in content.items() if v is not None}, "file.yaml")


@pytest.mark.parametrize(
    ("name", "entry", "wanted"),
    [
        ("R", {"value": 620, "unit": "mm"}, 0.62),
        ("Omega", {"value": 1500, "unit": "rpm", "source": "tachometer"}, 50.0 * math.pi),
        ("Omega", {"value": 25, "unit": "Hz"}, 50.0 * math.pi),
        ("Ixx", {"value": 240_000, "unit": "g cm^2"}, 0.024),
        ("a", {"value": 0.1, "unit": "1/deg"}, 18.0 / math.pi),
        ("a", {"value": 5.5}, 5.5),
        ("B", {"value": 97, "unit": "%"}, 0.97),
        ("Ixx", 1e-2, 0.01),
        ("Omega", 150, 150.0),
    ],
)
def test_units_are_converted(name, entry, wanted):
    found = read(**{name: entry})
    assert float(getattr(found.params, name)) == pytest.approx(wanted, rel=1e-13)
    assert found.constants[name].value == pytest.approx(wanted, rel=1e-13)
    assert found.constants[name].unit == naming.unit(Helicopter, name)


@pytest.mark.parametrize(
    "changes",
    [
        {"Ixy": 1.0},
        {"R3": 1.0},
        {1: 1.0},
        {"Ixx": None},
        {"Ixx": math.nan},
        {"Ixx": -math.inf},
        {"Ixx": 10**400},
        {"Ixx": {"value": 1e299, "unit": "kg Mm^2"}},
        {"Omega": 0.0},
        {"Ixx": -0.024},
        {"Ixx_added": -1e-3},
        {"zeta": -0.1},
        {"B": 1.2},
        {"Ixx": "heavy"},
        {"Ixx": True},
        {"Ixx": [0.024]},
        {"Ixx": {"unit": "kg m^2"}},
        {"Ixx": {"value": 1, "units": "kg"}},
        {"Ixx": {"value": 1, "unit": "kg"}},
        {"R": {"value": 1, "unit": "deg"}},
        {"R": {"value": 1, "unit": None}},
    ],
)
def test_wrong_constants_are_said_in_one_sentence(changes):
    content = {k: v for k, v in {**BENCH_30, **changes}.items() if v is not None}
    with pytest.raises(InputError) as e:
        vehicle_from_mapping(content, "file.yaml")
    assert str(e.value).startswith("file.yaml: ")
    assert "\n" not in str(e.value)


@pytest.mark.parametrize(("r1", "r2"), [(0.21, 0.13), (0.2, 0.2)])
def test_exchanged_paddle_ends_say_which_is_inner(r1, r2):
    with pytest.raises(InputError, match="R1 is the inner and R2 the outer end") as e:
        read(R1=r1, R2=r2)
    assert f"{r1:g}" in str(e.value)
    assert f"{r2:g}" in str(e.value)


@given(st.dictionaries(
    st.sampled_from([*BENCH_30, "m", "kappa", "B"]),
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8),
        st.lists(st.integers(), max_size=2),
        st.fixed_dictionaries({"value": st.floats()}, optional={"unit": st.text(max_size=6)}),
    ),
))  # fmt: skip
def test_a_vehicle_is_possible_or_an_input_error(changes):
    try:
        found = vehicle_from_mapping({**BENCH_30, **changes}, "file.yaml")
    except InputError:
        return
    numbers = {n: float(getattr(found.params, n)) for n in {**BENCH_30, **changes}}
    assert all(math.isfinite(v) for v in numbers.values())
    assert numbers["R1"] < numbers["R2"]
    assert all(numbers[n] > 0 for n in ("Ixx", "If", "Omega", "R", "L1"))


def test_a_user_mapping_of_names(tmp_path):
    from typing import Annotated, NamedTuple

    class Params(NamedTuple):
        Lp: Annotated[float, "1/s"]
        Lda: float
        delay: Annotated[float, "s"] = 0.0

    path = tmp_path / "mine.yaml"
    path.write_text("Lp: -3.0\nLda: 2\ndelay: {value: 20, unit: ms}\n")
    found = load_vehicle(path, Params)
    assert isinstance(found, Params)
    assert (float(found.Lp), float(found.Lda)) == (-3.0, 2.0)
    assert float(found.delay) == pytest.approx(0.02)
    path.write_text("Lp: -3.0\nLdb: 2\n")
    with pytest.raises(InputError, match=r"mine\.yaml: unknown constant 'Ldb'; did you mean 'Lda'"):
        load_vehicle(path, Params)


def moment(p):
    return p.cyclic_moment * p.rho * p.Omega**2 * p.a * p.c * p.R**4


def test_passes_through_jit_grad_and_vmap(bench30):
    value, slopes = jax.jit(jax.value_and_grad(moment))(bench30)
    by_hand = 0.5 * 1.2 * 150.0**2 * 5.1 * 0.045 * 0.62**4
    assert float(value) == pytest.approx(by_hand, rel=1e-13)
    assert isinstance(slopes, Helicopter)
    assert float(slopes.R) == pytest.approx(4.0 * by_hand / 0.62, rel=1e-13)
    assert float(slopes.Ixx) == 0.0
    radii = jnp.linspace(0.5, 0.7, 3)
    many = jax.vmap(lambda r: moment(naming.replace(bench30, R=r)))(radii)
    np.testing.assert_allclose(many, by_hand * (np.asarray(radii) / 0.62) ** 4, rtol=1e-13)
    batch = jax.tree.map(lambda v: jnp.broadcast_to(v, (3,)), bench30)
    np.testing.assert_allclose(jax.vmap(moment)(batch), by_hand, rtol=1e-13)
