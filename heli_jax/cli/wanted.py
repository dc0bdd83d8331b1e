"""Wanted standard deviations of a command line (`--for a=2%`)."""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from heli_jax.errors import InputError


class Wanted(NamedTuple):
    """A wanted standard deviation."""

    sd: float
    relative: bool
    """True if it is a fraction of the value."""

    def reached(self, value: float, sd: float) -> bool:
        return sd <= self.sd * (abs(value) if self.relative else 1.0)


def wanted_of(texts: Sequence[str]) -> dict[str, Wanted]:
    """Return the wanted sds by name, of texts such as `a=2%` and `a/Ixx=0.5`.

    Raises:
        InputError: a text of another form.
    """
    wanted = {}
    for text in texts:
        found = re.fullmatch(r"(.+)=([0-9.]+(?:[eE][+-]?[0-9]+)?)(%?)", text)
        number = float(found[2]) if found and found[2].count(".") < 2 and found[2] != "." else 0.0
        if found is None or not 0.0 < number < math.inf:
            raise InputError(f"--for: expected NAME=SD or NAME=PERCENT%, got {text!r:.60}")
        wanted[found[1]] = Wanted(number / (100.0 if found[3] else 1.0), bool(found[3]))
    return wanted
