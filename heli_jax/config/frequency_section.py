"""Section `frequency` of a configuration: responses of the logs, and their fit."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from heli_jax.config.section import Section

_Coherence = Annotated[float, Field(ge=0, lt=1)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def _increasing(band: tuple[float, float]) -> tuple[float, float]:
    if not band[0] < band[1]:
        raise ValueError(f"expected two increasing frequencies in Hz, got {list(band)}")
    return band


_Band = Annotated[tuple[_Positive, _Positive], AfterValidator(_increasing)]


class TransferConfig(Section):
    """A transfer function to be fitted to one response."""

    input: str
    """the model's name"""
    output: str
    """the model's name"""
    zeros: Annotated[int, Field(ge=0, le=8)] = 0
    """number of the transfer function's roots"""
    poles: Annotated[int, Field(ge=1, le=8)]
    """number of the transfer function's roots"""
    delay: bool = True
    """true: with a delay"""
    band: _Band | None = None
    """[Hz]; all frequencies unless given"""
    coherence: _Coherence = 0.6
    """frequencies of less are left out"""

    @model_validator(mode="after")
    def _proper(self) -> "TransferConfig":
        if self.zeros > self.poles:
            raise ValueError(
                f"zeros: expected at most as many as poles ({self.poles}), got {self.zeros}"
            )
        return self


class PairConfig(Section):
    """A response that is to be fitted."""

    input: str
    """the model's name"""
    output: str
    """the model's name"""
    band: _Band | None = None
    """[Hz]; that of all unless given"""
    coherence: _Coherence | None = None
    """likewise"""


class HandlingConfig(Section):
    """A response that handling qualities are read off."""

    input: str
    """the model's name"""
    output: str
    """an angle, or a rate [rad/s], whose response is integrated"""
    response: Literal["rate", "attitude-command", "open-loop"] = "rate"
    """kind of response in ADS-33E-PRF"""
    gain: Annotated[float, Field(allow_inf_nan=False)] = 1.0
    """gain of the open loop beside this response; negative to change the sign"""

    @model_validator(mode="after")
    def _of_a_loop(self) -> "HandlingConfig":
        if self.gain != 1.0 and self.response != "open-loop":
            raise ValueError(f"gain: expected response: open-loop with it, got {self.response}")
        if self.gain == 0.0:
            raise ValueError("gain: expected a number other than 0")
        return self


class FrequencyConfig(Section):
    """Frequencies, and the length of the windows."""

    band: _Band | None = None
    """first and last frequency [Hz]; unless given two periods in a window to 0.4 of the rate"""
    window: _Positive | None = None
    """length [s]; unless given a fifth of the longest flight, 30 s at most"""
    points: Annotated[int, Field(ge=8, le=2000)] | None = None
    """frequencies, equally spaced in the logarithm; 120 unless given, and for fit.method:
    frequency-response all that are independent"""
    coherence: _Coherence = 0.0
    """least partial coherence of fit.method: frequency-response, in the mean over an octave"""
    pairs: Annotated[list[PairConfig], Field(min_length=1)] | None = None
    """responses that are fitted; all unless given"""
    transfer_functions: list[TransferConfig] = []
    """fitted to the responses of the logs, by `heli-jax frf`"""
    handling: list[HandlingConfig] | None = None
    """responses whose handling qualities are shown; unless given those of roll, pitch and yaw to
    their sticks; [] for none"""
