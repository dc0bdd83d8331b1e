"""A fit whose model explains nothing of what was measured determines nothing of it either."""

from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.validation.adequacy import Adequacy


def unless_explains_nothing(verdict: Verdict, adequacy: Adequacy) -> Verdict:
    """The verdict; where every output is followed worse than by its mean no parameter is
    determined.

    Args:
        verdict: what the data determine by the slopes at the optimum, and about it.
        adequacy: how the model explains what was measured.
    """
    # A disturbance, or predictions ahead, let a good model's simulation be as poor.
    judged = [o for o in adequacy.judged if o.against_disturbance is None]
    worse = bool(judged) and all(o.vaf < 0 for o in adequacy.judged)
    if not adequacy.denied or adequacy.ahead is not None or not worse:
        return verdict
    outputs = listed([o.output for o in adequacy.judged])
    sentence = (
        f"The data do not determine {listed(verdict.names, 'or')}: the model explains nothing of "
        f"{outputs} at this optimum. Start nearer, from several points (fit.starts), or from what "
        "the data say (start: equation-error)."
    )
    return verdict.nothing(sentence)
