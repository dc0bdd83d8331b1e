"""Packed numbers of NetCDF and HDF5 files, unpacked as the attributes beside them say.

Sources: the CF conventions 1.11, sections 2.5.1 and 8.1, and the attribute conventions of the
NetCDF User's Guide. Libraries apply some of them or none; here all files are unpacked alike.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.table import listed, shown

ATTRIBUTES = (
    *("scale_factor", "add_offset", "_FillValue", "missing_value", "_Unsigned"),
    *("valid_range", "valid_min", "valid_max"),
)
"""what is asked of a data set"""
UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit")


class Packing(ValueError):
    """An attribute that says how numbers are packed cannot be understood; in words which."""


class Unpacked(NamedTuple):
    """Numbers of a data set, of its shape, and how many are missing."""

    values: np.ndarray
    n_missing: int = 0


def unpack(stored: np.ndarray, attributes: Mapping[str, object]) -> Unpacked:
    """What stored numbers stand for: NaN for fills and what is no valid value, the rest scaled.

    Args:
        stored: of a data set, of any shape.
        attributes: of `ATTRIBUTES` those that it has.

    Raises:
        Packing: a scale or an offset is no number.
    """
    if stored.dtype.kind not in "iuf" or not attributes:
        return Unpacked(stored)
    stored = _signed(stored, attributes.get("_Unsigned"))
    scale, offset = (_one(attributes, name) for name in ("scale_factor", "add_offset"))
    is_scaled = scale is not None or offset is not None
    # In the packed numbers, which are compared exactly.
    missing = _fills(stored, attributes)
    packed = _outside(stored, attributes) if not _is_of_unpacked(stored, attributes) else None
    values = stored
    if is_scaled:
        values = stored.astype(np.float64)
        values = values * (1.0 if scale is None else scale) + (0.0 if offset is None else offset)
    missing |= _outside(values, attributes) if packed is None else packed
    count = int(np.count_nonzero(missing))
    if count:
        values = np.where(missing, np.nan, values.astype(np.float64))
    return Unpacked(values, count)


def notes_of(missing: Mapping[str, int], left_out: Mapping[str, str]) -> tuple[Finding, ...]:
    """Notes on how a file's data sets were read.

    Args:
        missing: by name the number of fills.
        left_out: by name why.
    """
    notes = []
    if missing:
        each = listed(f"{shown(name)} ({count})" for name, count in missing.items())
        words = f"the file's marks for no value are taken as missing samples: {each}"
        notes.append(note("samples.marks", words, *missing, value=sum(missing.values())))
    if left_out:
        words = f"left out: {listed(f'{shown(n)}, {w}' for n, w in left_out.items())}"
        notes.append(note(LEFT_OUT, words, *left_out))
    return tuple(notes)


def text_of(attribute: object) -> str:
    """The text of an attribute, which may be bytes or an array of one; empty of any other."""
    if isinstance(attribute, np.ndarray) and attribute.size == 1:
        attribute = attribute.ravel()[0]
    if isinstance(attribute, bytes):
        attribute = attribute.decode("utf-8", "replace")
    return attribute.strip("\0 ") if isinstance(attribute, str) else ""


def _signed(stored: np.ndarray, unsigned: object) -> np.ndarray:
    """Whole numbers with or without a sign, as NetCDF 3, which has no unsigned ones, notes it."""
    kind = {"true": "u", "false": "i"}.get(text_of(unsigned).lower())
    if kind is None or stored.dtype.kind not in "iu" or stored.dtype.kind == kind:
        return stored
    return stored.view(stored.dtype.str.replace(stored.dtype.kind, kind))


def _one(attributes: Mapping[str, object], name: str) -> float | None:
    """The number of an attribute, None where there is none."""
    if name not in attributes:
        return None
    numbers = _numbers(attributes[name])
    number = float(numbers[0]) if numbers.size == 1 else float("nan")
    if not np.isfinite(number) or (name == "scale_factor" and number == 0):
        raise Packing(f"since its {name} is no number that packs")
    return number


def _numbers(attribute: object) -> np.ndarray:
    """The numbers of an attribute (n,); empty where it holds none. Some writers put them in a
    text."""
    if text := text_of(attribute):
        try:
            return np.array([float(text)])
        except ValueError:
            return np.empty(0)
    numbers = np.atleast_1d(np.asarray(attribute)).ravel()
    return numbers if numbers.dtype.kind in "biuf" else np.empty(0)


def _fills(stored: np.ndarray, attributes: Mapping[str, object]) -> np.ndarray:
    """Where marks for no value stand."""
    missing = np.zeros(stored.shape, bool)
    for name in ("_FillValue", "missing_value"):
        for mark in _numbers(attributes[name]) if name in attributes else ():
            # In the stored type: as float64, -9999.9 is none of a float32's numbers, and of an
            # unsigned byte the mark is often written with a sign.
            with np.errstate(all="ignore"):
                same = np.asarray(mark).astype(stored.dtype)
            if stored.dtype.kind == "f" or _is_whole(mark, stored.dtype):
                missing |= stored == same
    return missing


def _is_whole(mark: np.number, kind: np.dtype) -> bool:
    """Whether a mark is a number of a whole type, with or without its sign."""
    if not np.isfinite(mark) or mark != np.rint(mark):
        return False
    bits = 8 * kind.itemsize
    return -(2 ** (bits - 1)) <= int(mark) < 2**bits


def _is_of_unpacked(stored: np.ndarray, attributes: Mapping[str, object]) -> bool:
    """Whether the valid range is one of unpacked numbers.

    The NetCDF User's Guide: where it has the type of the scale, and that is wider than what is
    stored, it is; otherwise it is one of the packed numbers.
    """
    scales = [np.asarray(attributes[n]).dtype for n in ("scale_factor", "add_offset")
              if n in attributes]  # fmt: skip
    ranges = [np.asarray(attributes[n]).dtype for n in ("valid_range", "valid_min", "valid_max")
              if n in attributes]  # fmt: skip
    if not scales or not ranges:
        return False
    widest = max(scales, key=lambda kind: kind.itemsize)
    is_wider = widest.kind == "f" and (
        stored.dtype.kind in "iu" or widest.itemsize > stored.dtype.itemsize
    )
    return is_wider and all(kind.kind == "f" for kind in ranges)


def _outside(values: np.ndarray, attributes: Mapping[str, object]) -> np.ndarray:
    """Where numbers are outside the valid range."""
    both = _numbers(attributes.get("valid_range", ()))
    low, high = both if both.size == 2 else (None, None)
    lowest, highest = (_numbers(attributes.get(n, ())) for n in ("valid_min", "valid_max"))
    low = lowest[0] if lowest.size == 1 else low
    high = highest[0] if highest.size == 1 else high
    outside = np.zeros(values.shape, bool)
    with np.errstate(invalid="ignore"):
        if low is not None:
            outside |= values < _in_type(low, values.dtype)
        if high is not None:
            outside |= values > _in_type(high, values.dtype)
    return outside


def _in_type(limit: np.number, kind: np.dtype) -> float | int | np.number:
    """A limit as a number of an unsigned type, which may be written with a sign."""
    return int(limit) + 2 ** (8 * kind.itemsize) if kind.kind == "u" and limit < 0 else limit
