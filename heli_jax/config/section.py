"""Base of all configuration sections: frozen, without unknown keys, and with finite numbers."""

import json
from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

# YAML reads .inf and .nan as numbers; a NaN would pass every comparison with a bound.
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Section(BaseModel):
    """Base of all sections."""

    # An unknown key is an error: a misspelt `lower` would leave a parameter without a bound, and
    # the lag of a misspelt device would be attributed to the vehicle. The string below a field is
    # its meaning in the JSON schema and for `heli-jax keys`.
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @classmethod
    def checked(cls, content: Mapping[str, Any]) -> Self:
        """Return the section of a file's content.

        Types are strict, as in the JSON schema for editors: true is not the number 1, and text is
        neither.

        Raises:
            pydantic.ValidationError: something in it is wrong.
        """
        return cls.model_validate_json(json.dumps(content, default=str), strict=True)
