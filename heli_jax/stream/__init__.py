"""Estimates while a flight goes on: `init`, `step -> (state, info)`, `estimate`."""

from heli_jax.stream.estimates import Estimated, Known, estimate
from heli_jax.stream.steps import Info, Sample, State, follow, init, step

__all__ = ["Estimated", "Info", "Known", "Sample", "State", "estimate", "follow", "init", "step"]
