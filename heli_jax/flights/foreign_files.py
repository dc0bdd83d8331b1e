"""Files that hold flights and are not read: what each is, and what to make of it instead."""

from pathlib import Path

from heli_jax.flights.table import wrong

_SHEET = "is a spreadsheet; save its sheet as CSV, one table with its names above"
_ROS = "is a bag of ROS"
_TOPICS = "export its topics to CSV (PlotJuggler does)"
_ARCHIVE = "is an archive; unpack it and name the log in it"
_TELEMETRY = (
    "is telemetry of MAVLink, thinned out on its way to the ground; take the autopilot's own log "
    "(.bin, .ulg), or export messages: mavlogdump.py --format csv --types ATTITUDE FILE"
)
_BY_ENDING = {
    **dict.fromkeys((".xlsx", ".xlsm", ".xls", ".xlsb", ".ods", ".numbers"), _SHEET),
    ".bag": f"{_ROS} 1; {_TOPICS}",
    ".mcap": f"is a recording in MCAP, as ROS 2 makes them; {_TOPICS}",
    ".db3": f"{_ROS} 2; {_TOPICS}",
    ".tlog": _TELEMETRY,
    ".rlog": _TELEMETRY,
    **dict.fromkeys(
        (".pkl", ".pickle", ".joblib"),
        "is a pickle of Python, which may run anything; save a table, frame.to_parquet(FILE), or "
        "arrays, numpy.savez(FILE, t=t, p=p)",
    ),
    **dict.fromkeys((".zip", ".7z", ".rar", ".tar", ".tgz", ".xz", ".bz2", ".zst"), _ARCHIVE),
    **dict.fromkeys(
        (".mf4", ".mdf"), "is a measurement in MDF; export it to CSV, or to MATLAB by asammdf"
    ),
    ".tdms": "is a measurement of LabVIEW in TDMS; export it to CSV (nptdms does)",
    ".c3d": "is a motion capture in C3D; export it to CSV",
    ".slx": "is a model of Simulink; save the signals that it logged as .mat",
    ".fig": "is a figure of MATLAB; save the numbers in it as .mat",
    ".kml": "is a track for a map, without attitudes; take the log that it was made from",
    ".gpx": "is a track for a map, without attitudes; take the log that it was made from",
    ".pdf": "is a document; expected the numbers as a table in text",
}
_BY_MARK = (
    (b"\x89MCAP0\r\n", _BY_ENDING[".mcap"]),
    (b"#ROSBAG V", _BY_ENDING[".bag"]),
    (b"SQLite format 3\0", _BY_ENDING[".db3"]),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", _SHEET),
    (
        b"version https://git-lfs.github.com/spec/",
        "is a pointer of Git LFS that stands for the log; git lfs pull fetches the log itself",
    ),
    (
        b"/annex/objects/",
        "is a pointer of git-annex that stands for the log; git annex get fetches the log itself",
    ),
    (b"FEA1", "is of the first version of Feather; write it anew, frame.to_feather(FILE)"),
    (b"TDSm", _BY_ENDING[".tdms"]),
    (b"MDF     ", _BY_ENDING[".mf4"]),
    (b"%PDF-", _BY_ENDING[".pdf"]),
)
_ZIP = b"PK\x03\x04"


def refuse(path: Path, head: bytes) -> None:
    """Refuse a file that is known not to be read, by its first bytes or by its ending.

    Args:
        path: of the file.
        head: its first bytes.

    Raises:
        InputError: with what to make of it.
    """
    ending = path.suffix.lower()
    words = next((words for mark, words in _BY_MARK if head.startswith(mark)), None)
    if words is None and head.startswith(_ZIP) and ending != ".npz":
        # Spreadsheets are archives inside.
        is_sheet = b"xl/" in head or b"[Content_Types].xml" in head or b"spreadsheet" in head
        words = _SHEET if is_sheet else _ARCHIVE
    words = words or _BY_ENDING.get(ending)
    if words is not None:
        raise wrong(str(path), words)
