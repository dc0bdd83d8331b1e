"""Other values that explain a record as well: then the data do not determine those parameters."""

from collections.abc import Sequence
from dataclasses import replace

from heli_jax.identification.estimation.noise_covariance import OtherValues
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.numbers import terse


def unless_as_likely(verdict: Verdict, others: Sequence[OtherValues]) -> Verdict:
    """The verdict; where other values explain the record as well, those parameters are not
    determined.

    Args:
        verdict: what the data determine about the optimum.
        others: found elsewhere.
    """
    if not verdict.identifiable or not others:
        return verdict
    sentences = tuple(
        f"The data do not determine {listed(tuple(o.values), 'or')}: "
        f"{listed([f'{n} = {terse(v, 3)}' for n, v in o.values.items()])} answer the inputs as do "
        f"{listed([f'{n} = {terse(v, 3)}' for n, v in o.instead_of.items()])}, and are as likely "
        f"(log-likelihood {terse(o.less, 2)} less). Bounds or a prior that leave one of the two "
        "out decide."
        for o in others
    )
    lost = {n for o in others for n in o.values}
    return replace(
        verdict,
        identifiable=False,
        combinations=(),
        pairs=(),
        undetermined=tuple(n for n in verdict.names if n in {*lost, *verdict.undetermined}),
        sentences=sentences,
        resting=(),
        roughly=(),
        through_zero=(),
    )
