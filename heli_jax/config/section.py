"""Base of all configuration sections: frozen, without unknown keys, and with finite numbers."""

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidatorFunctionWrapHandler, field_validator


class Section(BaseModel):
    """Base of all sections."""

    # An unknown key is an error: a misspelt `lower` would leave a parameter without a bound, and
    # the lag of a misspelt device would be attributed to the vehicle. The string below a field is
    # its meaning in the JSON schema and for `heli-jax keys`.
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @field_validator("*", mode="wrap")
    @classmethod
    def _a_number_is_written_as_one(cls, value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
        # In Python True equals 1, and pydantic converts it and "1" to 1.0. The JSON schema, by
        # which an editor checks the file, accepts neither.
        made = handler(value)
        for written, number in _numbers(value, made):
            if isinstance(written, bool) and number is not written:
                raise ValueError(f"expected a number, got {str(written).lower()}")
            # 1 is not accepted as true either.
            if isinstance(number, bool) and not isinstance(written, bool | str):
                raise ValueError(f"expected true or false, got {written}")
            if isinstance(written, str):
                kind = "true or false" if isinstance(number, bool) else "a number"
                raise ValueError(f"expected {kind} without quotes, got the text {written!r:.60}")
        return made


# Any: the content of the file.
def _numbers(written: Any, made: Any) -> Iterator[tuple[Any, int | float]]:
    """Yield the numbers of a field, each with its text in the file."""
    if isinstance(made, int | float):
        yield written, made
    elif isinstance(made, Mapping) and isinstance(written, Mapping):
        for name in made.keys() & written.keys():
            yield from _numbers(written[name], made[name])
    elif isinstance(made, list | tuple) and isinstance(written, list | tuple):
        for each in zip(written, made, strict=False):
            yield from _numbers(*each)
