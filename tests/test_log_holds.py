"""Holds of inputs in `heli-jax frf`."""

import numpy as np
import pytest

from heli_jax import Flight
from heli_jax.cli.responses import between_samples


def _flight(hold: str, reason: dict[str, str]) -> Flight:
    t = np.arange(0.0, 4.0, 0.02)
    signals = {"lat": np.sin(t)}, {"p": np.cos(t)}
    return Flight(0.02, *signals, hold={"lat": hold}, hold_reason=reason)


def test_what_a_log_decided_of_an_input_between_samples_is_said_with_what_hangs_on_it() -> None:
    decided = _flight("linear", {"lat": "moves at 100 % of the samples"})
    (note,) = between_samples([decided], ["lat"])
    assert (note.code, note.value) == ("hold.guessed", pytest.approx(0.01))
    assert not between_samples([_flight("linear", {})], ["lat"])  # as stated
    assert not between_samples([_flight("zero-order", {"lat": "jumps once and stays"})], ["lat"])
    (note,) = between_samples([decided, _flight("zero-order", {})], ["lat"])
    assert (note.code, note.subjects) == ("hold.differs", ("lat",))


def test_several_inputs_that_were_guessed_are_told_of_in_one_sentence() -> None:
    flight = _flight("linear", {"lat": "moves at 100 % of the samples"})
    lat = flight.inputs["lat"]
    both = Flight(
        0.02,
        {"lat": lat, "lon": lat},
        {"p": lat},
        hold={"lat": "linear", "lon": "linear"},
        hold_reason=dict.fromkeys(("lat", "lon"), "moves at 100 % of the samples"),
    )
    (note,) = between_samples([both], ["lat", "lon"])
    assert (note.code, note.subjects) == ("hold.guessed", ("lat", "lon"))
