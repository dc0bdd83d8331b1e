"""Record classes of every kind that the package accepts."""

import dataclasses
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
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
