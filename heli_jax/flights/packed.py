"""Packed numbers of NetCDF and HDF5 files, unpacked as the attributes beside them say.

Sources: the CF conventions 1.11, sections 2.5.1 and 8.1, and the attribute conventions of the
NetCDF User's Guide. Libraries apply some of them or none; here all files are unpacked alike.
"""

from collections.abc import Mapping

import numpy as np

ATTRIBUTES = (
    *("scale_factor", "add_offset", "_FillValue", "missing_value", "_Unsigned"),
    *("valid_range", "valid_min", "valid_max"),
)
"""what is asked of a data set"""
UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit")


class Packing(ValueError):
    """An attribute that says how numbers are packed cannot be understood; in words which."""


def unpack(stored: np.ndarray, attributes: Mapping[str, object]) -> tuple[np.ndarray, int]:
    """What stored numbers stand for: NaN for fills and what is no valid value, the rest scaled; and
    how many are missing.

    Raises:
        Packing: a scale or an offset is no number.
    """
    if stored.dtype.kind not in "iuf" or not attributes:
        return stored, 0
    kind = {"true": "u", "false": "i"}.get(text_of(attributes.get("_Unsigned")).lower())
    if kind and stored.dtype.kind in "iu":
        # NetCDF 3 has no unsigned numbers, and notes it.
        stored = stored.view(stored.dtype.str.replace(stored.dtype.kind, kind))
    missing = np.zeros(stored.shape, bool)
    for name in ("_FillValue", "missing_value"):
        for mark in _numbers(attributes.get(name, ())):
            # In the stored type: as float64, -9999.9 is none of a float32's numbers, and of an
            # unsigned byte the mark is often written with a sign.
            with np.errstate(all="ignore"):
                same = np.asarray(mark).astype(stored.dtype)
                whole = bool(mark == np.rint(mark)) and abs(mark) < 2.0 ** (8 * same.itemsize)
            if stored.dtype.kind == "f" or whole:
                missing |= stored == same
    scale, offset = _one(attributes, "scale_factor", 1.0), _one(attributes, "add_offset", 0.0)
    values = stored
    if (scale, offset) != (1.0, 0.0):
        values = stored.astype(np.float64) * scale + offset
    for name, beyond in (("valid_min", np.less), ("valid_max", np.greater)):
        both = _numbers(attributes.get("valid_range", ()))
        limits = both[[0 if name == "valid_min" else 1]] if both.size == 2 else both[:0]
        limits = _numbers(attributes[name]) if name in attributes else limits
        if limits.size == 1:
            # The range has the type of the packed numbers, or of the unpacked ones.
            of = stored if limits.dtype.kind in "iu" or values is stored else values
            limit = limits[0]
            if of.dtype.kind == "u" and limit < 0:
                limit = int(limit) + 2 ** (8 * of.dtype.itemsize)
            with np.errstate(invalid="ignore"):
                missing |= beyond(of, limit)
    count = int(np.count_nonzero(missing))
    return (np.where(missing, np.nan, values.astype(np.float64)) if count else values), count


def text_of(attribute: object) -> str:
    """The text of an attribute, which may be bytes or an array of one; empty of any other."""
    if isinstance(attribute, np.ndarray) and attribute.size == 1:
        attribute = attribute.ravel()[0]
    if isinstance(attribute, bytes):
        attribute = attribute.decode("utf-8", "replace")
    return attribute.strip("\0 ") if isinstance(attribute, str) else ""


def _one(attributes: Mapping[str, object], name: str, otherwise: float) -> float:
    """The number of an attribute."""
    if name not in attributes:
        return otherwise
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
