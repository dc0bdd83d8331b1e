"""Section `frequency` of a configuration: responses of the logs, and their fit."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from heli_jax.config.section import Positive, Section

_Coherence = Annotated[float, Field(ge=0, lt=1)]


def _increasing(band: tuple[float, float]) -> tuple[float, float]:
    if not band[0] < band[1]:
        raise ValueError(f"expected two increasing frequencies in Hz, got {list(band)}")
    return band


_Band = Annotated[tuple[Positive, Positive], AfterValidator(_increasing)]


class TransferConfig(Section):
    """A transfer function to fit to one response."""

    input: str
    """name of the model's input"""
    output: str
    """name of the model's output"""
    zeros: Annotated[int, Field(ge=0, le=8)] = 0
    """number of zeros"""
    poles: Annotated[int, Field(ge=1, le=8)]
    """number of poles"""
    delay: bool = True
    """true: with a delay"""
    band: _Band | None = None
    """band [Hz]; default all frequencies"""
    coherence: _Coherence = 0.6
    """least coherence of the frequencies used"""

    @model_validator(mode="after")
    def _proper(self) -> "TransferConfig":
        if self.zeros > self.poles:
            raise ValueError(
                f"zeros: expected at most as many as poles ({self.poles}), got {self.zeros}"
            )
        return self


class PairConfig(Section):
    """A response to fit."""

    input: str
    """name of the model's input"""
    output: str
    """name of the model's output"""
    band: _Band | None = None
    """band [Hz]; default the common one"""
    coherence: _Coherence | None = None
    """least coherence; default the common one"""


class HandlingConfig(Section):
    """A response for handling qualities."""

    input: str
    """name of the model's input"""
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
    """first and last frequency [Hz]; default two periods in a window to 0.4 of the rate"""
    window: Positive | None = None
    """length of a window [s]; default a fifth of the longest flight, at most 30 s"""
    points: Annotated[int, Field(ge=8, le=2000)] | None = None
    """number of frequencies, equally spaced in the logarithm; default 120, and for fit.method:
    frequency-response all independent ones"""
    coherence: _Coherence = 0.0
    """least partial coherence for fit.method: frequency-response, as the mean over an octave"""
    pairs: Annotated[list[PairConfig], Field(min_length=1)] | None = None
    """responses to fit; default all"""
    transfer_functions: list[TransferConfig] = []
    """transfer functions that `heli-jax frf` fits to the responses of the logs"""
    handling: list[HandlingConfig] | None = None
    """responses whose handling qualities are shown; default those of roll, pitch and yaw to their
    sticks; [] for none"""
