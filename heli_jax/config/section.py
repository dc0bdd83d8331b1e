"""What every section of a configuration is: frozen, without unknown keys, and of numbers that are
numbers."""

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidatorFunctionWrapHandler, field_validator


class Section(BaseModel):
    """The base of all sections."""

    # An unknown key is an error: a misspelt `lower` would leave a parameter without a bound, a
    # misspelt device its lag to the machine.
    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*", mode="wrap")
    @classmethod
    def _true_is_no_number(cls, value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
        # Python counts with True as with 1, and pydantic makes 1.0 of it.
        made = handler(value)
        if isinstance(value, bool) and isinstance(made, int | float) and made is not value:
            raise ValueError(f"expected a number, got {str(value).lower()}")
        return made
