"""Record classes of every accepted kind."""

import dataclasses
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import naming


class Tuple(NamedTuple):
    Lp: Annotated[float, "1/s", "roll damping"]
    Lda: float
    delay: Annotated[float, "s"] = 0.1


class Module(eqx.Module):
    Lp: Annotated[float, "1/s", "roll damping"]
    Lda: float
    delay: Annotated[float, "s"] = 0.1


@dataclasses.dataclass
class Data:
    Lp: Annotated[float, "1/s", "roll damping"]
    Lda: float
    delay: Annotated[float, "s"] = 0.1


class Plain:
    def __init__(self, Lp: Annotated[float, "1/s", "roll damping"], Lda: float, delay=0.1):
        self.Lp, self.Lda, self.delay = Lp, Lda, delay


@pytest.mark.parametrize("record", [Tuple, Module, Data, Plain])
def test_fields_of_any_record(record):
    assert naming.names(record) == ("Lp", "Lda", "delay")
    assert naming.defaults(record) == {"delay": 0.1}
    one = record(Lp=-3.0, Lda=2.0)
    assert naming.asdict(one) == {"Lp": -3.0, "Lda": 2.0, "delay": 0.1}
    changed = naming.replace(one, Lda=5.0)
    assert type(changed) is record
    assert naming.asdict(changed) == {"Lp": -3.0, "Lda": 5.0, "delay": 0.1}
    assert one.Lda == 2.0


@pytest.mark.parametrize("record", [Tuple, Module, Data])
def test_units_and_meanings(record):
    assert naming.unit(record, "Lp") == "1/s"
    assert naming.meaning(record, "Lp") == "roll damping"
    assert naming.unit(record, "delay") == "s"
    assert naming.meaning(record, "delay") == ""
    assert naming.unit(record, "Lda") is None
    assert naming.unit(record, "nothing") is None


@pytest.mark.parametrize("record", [Tuple, Module, Data])
def test_extended_keeps_names_units_and_defaults(record):
    More = naming.extended(
        record,
        "More",
        {"extra": (Annotated[float, "m", "length"], None), "tau": (Annotated[float, "s"], 1.0)},
    )
    assert set(naming.names(More)) == {"Lp", "Lda", "delay", "extra", "tau"}
    assert naming.defaults(More) == {"delay": 0.1, "tau": 1.0}
    assert naming.unit(More, "Lp") == "1/s"
    assert naming.meaning(More, "extra") == "length"
    one = More(Lp=1.0, Lda=2.0, extra=3.0)
    assert naming.asdict(one) == {"Lp": 1.0, "Lda": 2.0, "extra": 3.0, "delay": 0.1, "tau": 1.0}
    assert sorted(jax.tree.leaves(one)) == [0.1, 1.0, 1.0, 2.0, 3.0]


@pytest.mark.parametrize("record", [Tuple, Module, Data, Plain])
def test_a_record_as_a_vector_and_back(record):
    vector = naming.ravel(record(Lp=1.0, Lda=2.0, delay=3.0))
    np.testing.assert_array_equal(vector, [1.0, 2.0, 3.0])
    back = naming.unravel(record, vector)
    assert type(back) is record
    assert naming.asdict(back) == {"Lp": 1.0, "Lda": 2.0, "delay": 3.0}


def test_a_part_of_a_record_in_an_order_and_a_type_of_one_s_own():
    vector = naming.ravel(Tuple(1, 2, 3), np.float32, ("delay", "Lp"))
    assert vector.dtype == np.float32
    np.testing.assert_array_equal(vector, [3.0, 1.0])


@pytest.mark.parametrize("n", [2, 4])
def test_a_vector_of_another_length_is_no_record(n):
    with pytest.raises(ValueError, match="zip"):
        naming.unravel(Tuple, jnp.zeros(n))


def test_derivatives_pass_through_vectors():
    def scaled(x):
        record = naming.unravel(Tuple, x)
        return naming.ravel(record._replace(Lp=2.0 * record.Lp))

    jacobian = jax.jacfwd(scaled)(np.ones(3))
    np.testing.assert_array_equal(jacobian, np.diag([2.0, 1.0, 1.0]))
