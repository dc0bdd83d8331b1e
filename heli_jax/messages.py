"""Texts of findings: `messages.yaml` has a title, a sentence and a remedy for each code.

A field of a sentence takes Python's formats, and these:

- `{p:p}` a probability, `{x:vaf}` a VAF, `{x:%}` a share in per cent
- `{names}` a list as `a, b and c`, `{names:or}` as `a, b or c`; `{shares:.2g}` each of a list
- `{names:follows/follow}` the singular or plural form of a word
- `{lead:? (* s earlier)}` the rest with `*` replaced by the value; nothing if the value is empty
"""

import functools
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from heli_jax.numbers import p_value, percent, plain_words, vaf_text
from heli_jax.yaml_file import read_mapping


class Message(NamedTuple):
    """Texts of one code."""

    title: str
    text: str
    """Sentence with fields for the finding's numbers."""
    remedy: str = ""
    brief: str = ""
    """Short form for the statements of a report."""
    measure: str = ""
    """Meaning of the finding's value, and its limit."""
    page: str = ""
    """Page of the documentation, without `.md`."""


@functools.cache
def messages() -> Mapping[str, Message]:
    """Return the texts of each code."""
    content = read_mapping(Path(__file__).with_suffix(".yaml"))
    return {code: Message(**words) for code, words in content.items()}


def written(template: str, numbers: Mapping[str, Any]) -> str:
    """Return a sentence with its numbers.

    Args:
        template: text of a `Message`.
    """
    return _FORMATTER.vformat(template, (), numbers).strip()


def sentence(code: str, **numbers: Any) -> str:
    """Return the text and the remedy of a message."""
    message = messages()[code]
    return written(" ".join(filter(None, (message.text, message.remedy))), numbers)


def listed(names: Sequence[str], joined: str = "and") -> str:
    """Return names as `a, b and c`; empty for no names."""
    *first, last = names or ("",)
    return f"{', '.join(first)} {joined} {last}" if first else last


class _Formatter(string.Formatter):
    def format_field(self, value: Any, format_spec: str) -> str:
        several = isinstance(value, list | tuple)
        if format_spec.startswith("?"):
            return format_spec[1:].replace("*", self.format_field(value, "")) if value else ""
        if "/" in format_spec:
            one, many = format_spec.split("/")
            count = len(value) if several else value
            return one if count == 1 else many
        if several:
            joined = "or" if format_spec == "or" else "and"
            spec = "" if format_spec == "or" else format_spec
            return listed([self.format_field(v, spec) for v in value], joined)
        if format_spec in _KINDS:
            return _KINDS[format_spec](value)
        return super().format_field(value, format_spec)


_KINDS = {
    "p": p_value,
    "vaf": vaf_text,
    "%": lambda share: plain_words(percent(share, 0)),
}
_FORMATTER = _Formatter()
