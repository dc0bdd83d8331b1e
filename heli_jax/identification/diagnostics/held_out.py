"""Do the estimates predict flights that they were not fitted to?"""

from collections.abc import Iterator

from heli_jax.finding import Finding, found
from heli_jax.identification.agreement import pooled_metrics
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.validation.adequacy import WORSE


def held_out_predicted(c: Context) -> Iterator[Finding]:
    """Flights held out that the model does not predict."""
    yield from c.held_out.notes
    if c.held_out.in_frequency is not None:
        yield from c.held_out.in_frequency.findings
        return
    # With gusts in the model, or no simulation in the fit, a simulation says little.
    if c.at.layout.noise_model != "white":
        return
    for name, m in pooled_metrics(c.held_out.signals).items():
        # By more than chance makes of an output that does not respond.
        if not m.vaf >= WORSE:
            yield found(
                "held-out.worse-than-mean", "doubt", name, value=m.vaf, denies=True, limit=WORSE
            )
