"""Units as files spell them: `degrees_per_second`, `deg s-1`, `m/s²`, `Grad/s`, `deg_s`.

Apart from `units.py`, which knows what a unit is worth: here is only how it is written.
"""

import re

_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_RAISED = re.compile(r"([A-Za-z°%])([⁻]?[¹²³⁴⁵⁶⁷⁸⁹])")
_PER = re.compile(r"(?<=[A-Za-z°%])(?:_| )+per(?:_| )+|(?<=[a-z])p(?=s$|s\^?2$)")
# As UDUNITS has it (Unidata): an exponent right behind the name, products by a point.
_EXPONENT = re.compile(r"(?<=[A-Za-zµ°])(-?[1-9])(?![0-9.])")
_POINT = re.compile(r"(?<=[A-Za-z0-9])\.(?=[A-Za-z])")
# In a name there is no stroke: deg_s. Of these no product with a second is logged.
_UNDERLINED = re.compile(
    r"(deg|degree|degrees|rad|radian|radians|mrad|cdeg|m|meter|meters|metre|metres|cm|mm|ft|km)"
    r"_(s|sec|secs|second|seconds|h|min)(\^?2)?"
)
_WORDS = {
    "dps": "deg/s", "radps": "rad/s", "mps": "m/s", "metre": "m", "metres": "m",
    "Grad": "deg", "grad": "deg", "percentage": "percent", "pct": "percent", "secs": "s",
    **dict.fromkeys(("U/min", "Upm", "tr/min"), "rpm"),
}  # fmt: skip
_WORD = re.compile(r"[A-Za-zµ°%_]+")


def as_known(text: str) -> str:
    """A unit in the spelling that `units` reads: names with `^` exponents, products and quotients.

    Args:
        text: as a file spells it.
    """
    text = _RAISED.sub(lambda m: f"{m[1]}^{m[2].translate(_SUPERSCRIPTS)}", text.strip())
    if text in _WORDS:
        return _WORDS[text]
    if match := _UNDERLINED.fullmatch(text):
        text = f"{match[1]}/{match[2]}{'^2' if match[3] else ''}"
    text = _EXPONENT.sub(r"^\1", _POINT.sub(" ", _PER.sub("/", text)))
    return _WORD.sub(lambda m: _WORDS.get(m[0], m[0]), text)
