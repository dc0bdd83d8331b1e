"""Writers of small autopilot logs, from the formats' documentation with struct alone."""

import struct

import numpy as np

# ULog: sizes and struct codes of the types used in tests.
_ULOG = {"uint64_t": "Q", "int32_t": "i", "float": "f", "uint8_t": "B", "uint16_t": "H"}


def _message(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(topics, parameters=(), information=(), dropouts=(), start=10_000_000):
    """Return a ULog.

    Args:
        topics: (name, instance, [(type, field), ...], rows); timestamps [us] come first.
    """
    out = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", start)]
    out.append(_message("B", bytes(40)))
    for key, text in information:
        head = f"char[{len(text)}] {key}".encode()
        out.append(_message("I", bytes([len(head)]) + head + text.encode()))
    for key, value in parameters:
        head = f"{'float' if isinstance(value, float) else 'int32_t'} {key}".encode()
        packed = struct.pack("<f" if isinstance(value, float) else "<i", value)
        out.append(_message("P", bytes([len(head)]) + head + packed))
    for name in dict.fromkeys(t[0] for t in topics):
        fields = next(t[2] for t in topics if t[0] == name)
        text = name + ":" + "".join(f"{kind} {field};" for kind, field in fields)
        out.append(_message("F", text.encode()))
    for i, (name, instance, *_) in enumerate(topics):
        out.append(_message("A", struct.pack("<BH", instance, i) + name.encode()))
    data = []
    for i, (_, _, fields, rows) in enumerate(topics):
        # Firmware omits the padding at the end.
        kinds = [_code(kind) for kind, field in fields if "_padding" not in field]
        count = sum(int(kind[:-1] or 1) for kind in kinds)
        code = "<H" + "".join(kinds)
        data += [(row[0], _message("D", struct.pack(code, i, *row[:count]))) for row in rows]
    out += [message for _, message in sorted(data, key=lambda pair: pair[0])]
    out += [_message("O", struct.pack("<H", length)) for length in dropouts]
    return b"".join(out)


def _code(kind):
    name, _, rest = kind.partition("[")
    return f"{rest[:-1]}{_ULOG[name]}" if rest else _ULOG[name]


_DATAFLASH = {
    "Q": "Q", "I": "I", "f": "f", "B": "B", "h": "h", "c": "h", "C": "H", "e": "i", "L": "i",
    "n": "4s", "N": "16s", "Z": "64s", "b": "b", "H": "H", "d": "d", "q": "q", "M": "B", "a": "64s",
}  # fmt: skip


def dataflash(messages, rows):
    """Return a DataFlash log.

    Args:
        messages: name -> (number, kinds, columns).
        rows: (name, values) as stored.
    """
    out = []
    known = {"FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns")} | messages
    for name, (number, kinds, columns) in known.items():
        length = 3 + struct.calcsize("<" + "".join(_DATAFLASH[k] for k in kinds))
        cells = (name.encode(), kinds.encode(), columns.encode())
        out.append(b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, *cells))
    for name, values in rows:
        number, kinds, _ = known[name]
        code = "<" + "".join(_DATAFLASH[k] for k in kinds)
        out.append(b"\xa3\x95" + bytes([number]) + struct.pack(code, *values))
    return b"".join(out)


def dataflash_text(messages, rows):
    """Return the same as text; a cell has the meaning of the field."""
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    lines += [f"FMT, {n}, 50, {name}, {k}, {c}" for name, (n, k, c) in messages.items()]
    lines += [", ".join([name, *map(str, values)]) for name, values in rows]
    return ("\n".join(lines) + "\n").encode()


# Blackbox: conversion of a group of fields to bytes, by the number of its encoding.
def unsigned(value):
    value &= 0xFFFFFFFF
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def signed(value):
    return unsigned(value << 1 if value >= 0 else (-value << 1) - 1)


def _fits(value, bits):
    return -(1 << bits - 1) <= value < 1 << bits - 1


def tag8_8svb(values):
    if len(values) == 1:
        return signed(values[0])
    tag = sum(1 << i for i, v in enumerate(values) if v)
    return bytes([tag]) + b"".join(signed(v) for v in values if v)


def tag8_4s16(values):
    values = [*values, 0, 0, 0][:4]
    nibbles, tag = "", 0
    for i, v in enumerate(values):
        code = 0 if v == 0 else 1 if _fits(v, 4) else 2 if _fits(v, 8) else 3
        tag |= code << 2 * i
        bits = (0, 4, 8, 16)[code]
        nibbles += f"{v & (1 << bits) - 1:0{bits}b}" if bits else ""
    nibbles += "0" * (-len(nibbles) % 8)
    return bytes([tag]) + bytes(int(nibbles[i : i + 8], 2) for i in range(0, len(nibbles), 8))


def _three(values, widths):
    for code, bits in enumerate(widths):
        if all(_fits(v, b) for v, b in zip(values, bits, strict=True)):
            text = "".join(f"{v & (1 << b) - 1:0{b}b}" for v, b in zip(values, bits, strict=True))
            size = 8 * (code + 1)
            # The fields end at the last bit; zeros fill the space after the code.
            return int(f"{code:02b}" + text.rjust(size - 2, "0"), 2).to_bytes(code + 1, "big")
    sizes = [next(n for n in (1, 2, 3, 4) if _fits(v, 8 * n)) for v in values]
    lead = 0b11000000 | sum((n - 1) << 2 * i for i, n in enumerate(sizes))
    parts = (v.to_bytes(n, "little", signed=True) for v, n in zip(values, sizes, strict=True))
    return bytes([lead]) + b"".join(parts)


def tag2_3s32(values):
    # 6, 6 and 6 bits have a byte each, so the fields are spread.
    if all(_fits(v, 2) for v in values) or not all(_fits(v, 6) for v in values):
        return _three(values, ((2, 2, 2),))
    if all(_fits(v, 4) for v in values):
        a, b, c = (v & 15 for v in values)
        return bytes([1 << 6 | a, b << 4 | c])
    a, b, c = (v & 63 for v in values)
    return bytes([2 << 6 | a, b, c])


def tag2_3svariable(values):
    return _three(values, ((2, 2, 2), (5, 5, 4), (8, 7, 7)))


def _alone(encode):
    return lambda values: b"".join(encode(v) for v in values)


ENCODERS = {
    0: (_alone(signed), 1),
    1: (_alone(unsigned), 1),
    3: (_alone(lambda v: unsigned(-v & 0x3FFF)), 1),
    6: (tag8_8svb, 8),
    7: (tag2_3s32, 3),
    8: (tag8_4s16, 4),
    9: (lambda values: b"", 1),
    10: (tag2_3svariable, 3),
}


def encode(values, encodings):
    """Return the fields of one frame as bytes; fields of one encoding share tags if possible."""
    out, at = b"", 0
    while at < len(values):
        encoder, most = ENCODERS[encodings[at]]
        end = at + 1
        while end < len(values) and encodings[end] == encodings[at] and end - at < most:
            end += 1
        group = [int(v) for v in values[at:end]]
        if encodings[at] in (7, 10):
            group = [*group, 0, 0][:3]
        out += encoder(group)
        at = end
    return out


MARK = "H Product:Blackbox flight data recorder by Nicholas Sherlock"
END = b"E\xffEnd of log\x00"


def blackbox(
    names, values, predictors, encodings, *, every=32, step=1, settings=(), slow=(), gps=()
):
    """Return one flight of a blackbox log.

    Args:
        names: fields after loopIteration and time [us].
        values: (N, 2 + F), including those two.
        predictors: of the F fields in P frames: 0 none, 1 previous, 2 straight line, 3 mean.
        encodings: of the F fields in P frames.
        every: iterations between I frames.
        step: iterations between frames.
        settings: lines of the header, (name, value).
        slow: (row, value) of S frames of one field, each before the frame of that row.
        gps: (row, us after the last frame, satellites) of G frames, each before that row's frame.
    """
    count = len(names)
    head = [MARK, "H Data version:2", f"H I interval:{every}", f"H P interval:{step}"]
    head += [
        "H Field I name:" + ",".join(["loopIteration", "time", *names]),
        "H Field I signed:" + ",".join(["0", "0", *["1"] * count]),
        "H Field I predictor:" + ",".join(["0"] * (count + 2)),
        "H Field I encoding:" + ",".join(["1", "1", *["0"] * count]),
        "H Field P predictor:" + ",".join(map(str, [6, 2, *predictors])),
        "H Field P encoding:" + ",".join(map(str, [9, 0, *encodings])),
    ]
    if slow:
        head += ["H Field S name:mode", "H Field S signed:0"]
        head += ["H Field S predictor:0", "H Field S encoding:1"]
    if gps:
        head += ["H Field G name:time,GPS_numSat", "H Field G signed:0,0"]
        head += ["H Field G predictor:10,0", "H Field G encoding:1,1"]
    out = ["\n".join([*head, *(f"H {k}:{v}" for k, v in settings)]).encode() + b"\n"]
    predictors, slow = [6, 2, *predictors], dict(slow)
    gps = {row: numbers for row, *numbers in gps}
    before = earlier = None
    for row, value in enumerate(np.asarray(values).tolist()):
        if row in slow:
            out.append(b"S" + unsigned(slow[row]))
        if row in gps:
            out.append(b"G" + encode(gps[row], [1, 1]))
        if value[0] % every == 0:
            stamp = value[1] % 2**32  # the firmware's counter restarts
            out.append(b"I" + encode([value[0], stamp, *value[2:]], [1, 1, *[0] * count]))
            before = earlier = value
            continue
        deltas = [
            v - _prediction(p, a, b, step)
            for v, p, a, b in zip(value, predictors, before, earlier, strict=True)
        ]
        out.append(b"P" + encode(deltas, [9, 0, *encodings]))
        before, earlier = value, before
    return b"".join(out) + END


def _prediction(predictor, before, earlier, step):
    match predictor:
        case 1:
            return before
        case 2:
            return 2 * before - earlier
        case 3:
            return int((before + earlier) / 2)  # towards zero, as C divides
        case 6:
            return before + step
    return 0
