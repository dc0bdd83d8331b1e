"""Values written to a log are read back: units, window, Parquet."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from heli_jax.errors import InputError
from heli_jax.flights import ReadOptions, Signal, describe_log, read_flight

ASKED = {
    "time": "t",
    "inputs": {"x_roll": Signal("stick", "mm", "m")},
    "outputs": {"roll": Signal("phi", "rad", "rad")},
}
T = np.round(5.0 + 0.02 * np.arange(12), 2)
STICK = np.array([0, 1, 1, -2, 3.5, 0, 0, 1e-3, -7, 8, 9, 10.25])
PHI = np.sin(T)


def lines() -> list[str]:
    rows = zip(T, STICK, PHI, strict=True)
    return ["t,stick,phi", *(",".join(repr(float(x)) for x in row) for row in rows)]


def check(path: Path) -> None:
    flight = read_flight(path, **ASKED)
    assert flight.dt == pytest.approx(0.02, rel=1e-12)
    assert flight.t0 == 5.0
    assert np.array_equal(flight.outputs["roll"], PHI)
    assert np.array_equal(flight.inputs["x_roll"], STICK * 1e-3)
    assert flight.source is not None
    assert flight.source.notes == ()


@pytest.mark.parametrize("kind", [pa.float64(), pa.timestamp("us"), pa.duration("ms")])
def test_parquet(tmp_path, kind):
    path = tmp_path / "bench.parquet"
    ticks = {"us": 1e6, "ms": 1e3}.get(getattr(kind, "unit", ""), 1)
    stamps = pa.array(T if ticks == 1 else np.rint(T * ticks).astype(np.int64)).cast(kind)
    pq.write_table(pa.table({"t": stamps, "stick": STICK, "phi": PHI, "x": ["a"] * 12}), path)
    check(path)


def test_parquet_in_single_precision(tmp_path):
    path = tmp_path / "bench.parquet"
    stamps = (1000 + np.arange(500) / 400).astype(np.float32)
    x = np.arange(500, dtype=np.float32)
    pq.write_table(pa.table({"t": stamps, "stick": x, "phi": x}), path)
    assert read_flight(path, **ASKED).dt == pytest.approx(1 / 400, rel=1e-6)


def test_units_sd_and_known(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text("\n".join(lines()))
    flight = read_flight(
        path,
        time=Signal("t", "ms", "s"),
        inputs={"x_roll": Signal("stick", "%", "1"), "x_pitch": Signal("stick", "1", "1")},
        outputs={"roll": Signal("phi", "deg", "rad", 0.5)},
        known={"Ixx_added": 0.012},
        hold_out=True,
        name="second",
    )
    assert flight.dt == pytest.approx(2e-5)
    assert flight.inputs["x_roll"] == pytest.approx(STICK / 100)
    assert np.array_equal(flight.inputs["x_pitch"], STICK)
    assert flight.outputs["roll"] == pytest.approx(np.deg2rad(PHI))
    assert flight.sd == {"roll": pytest.approx(np.deg2rad(0.5))}
    assert (flight.known, flight.hold_out, flight.name) == ({"Ixx_added": 0.012}, True, "second")


def test_options_as_a_record_and_as_keywords(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines()))
    options = ReadOptions(window=(0.02, 0.2), hold_out=True, name="first")
    flight = read_flight(path, **ASKED, options=options, name="second")
    assert (flight.name, flight.hold_out, flight.n_samples) == ("second", True, 10)
    assert read_flight(path, **ASKED, known=None).known == {}
    with pytest.raises(TypeError, match="rat"):
        read_flight(path, **ASKED, rat=50.0)


def test_window_is_inclusive(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text("\n".join(lines()))
    flight = read_flight(path, **ASKED, window=(0.04, 0.2))
    assert flight.t0 == 5.04
    assert np.array_equal(flight.outputs["roll"], PHI[2:11])


def test_window_beyond_the_log_is_noted(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text("\n".join(lines()))
    flight = read_flight(path, **ASKED, window=(0.04, 60.0))
    assert flight.n_samples == 10
    assert flight.source is not None
    assert flight.source.notes[0].code == "windows.cut"


def test_what_is_wrong_outside_the_window_is_no_matter(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text("\n".join(lines()).replace("\n5.0,0.0,", "\n5.0,inf,"))
    with pytest.raises(InputError, match="line 2"):
        read_flight(path, **ASKED)
    assert read_flight(path, **ASKED, window=(0.02, 1.0)).n_samples == 11


# Single numbers above 1e9 among small ones mean no value: test_as_logged.py.
NUMBERS = st.floats(-1e8, 1e8, allow_subnormal=False)


@settings(max_examples=40, deadline=None)
@given(
    data=hnp.arrays(np.float64, st.tuples(st.integers(8, 40), st.just(2)), elements=NUMBERS),
    rate=st.sampled_from([1.0, 3.0, 50.0, 60.0, 400.0, 1000.0]),
    start=st.sampled_from([0.0, 12.5, 86400.0]),
    ending=st.sampled_from(["csv", "parquet"]),
)
def test_any_uniform_log_comes_back(tmp_path_factory, data, rate, start, ending):
    t = start + np.arange(len(data)) / rate
    path = tmp_path_factory.mktemp("logs") / f"log.{ending}"
    if ending == "csv":
        rows = [",".join(map(repr, map(float, row))) for row in np.column_stack([t, data])]
        path.write_text("\n".join(["t,stick,phi", *rows]))
    else:
        pq.write_table(pa.table({"t": t, "stick": data[:, 0], "phi": data[:, 1]}), path)
    flight = read_flight(
        path,
        time="t",
        inputs={"x_roll": Signal("stick", "1", "1")},
        outputs={"roll": Signal("phi", "1", "1")},
    )
    assert np.array_equal(flight.inputs["x_roll"], data[:, 0])
    assert np.array_equal(flight.outputs["roll"], data[:, 1])
    assert flight.dt == pytest.approx(1 / rate, rel=1e-9)
    assert flight.t0 == t[0]


CELLS = st.sampled_from(
    [
        *("0", "1", ".5", "nan", "inf", "1e400", "-1e308", "", " ", '"', "x", ",", ";", "\t", "\n"),
        *("\r", "#", "\ufeff", "\x1c", "\u2028", "1,5", '"2"', "t,stick,phi\n", "\n0,1,2"),
    ]
)
TEXT = st.lists(CELLS, max_size=60).map("".join) | st.text(max_size=80)
WITH_HEADER = TEXT.map(lambda body: "t,stick,phi\n" + body)


def only_input_errors(path: Path) -> None:
    for read in (lambda: read_flight(path, **ASKED, rate=3.0), lambda: describe_log(path)):
        try:
            read()
        except InputError as e:
            assert len(str(e).splitlines()) == 1  # noqa: PT017
            assert path.name in str(e)  # noqa: PT017


@settings(max_examples=80, deadline=None)
@given(text=TEXT | WITH_HEADER)
def test_no_text_breaks_the_reader(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(text.encode())
    only_input_errors(path)


@settings(max_examples=50, deadline=None)
@given(data=st.binary(max_size=200), ending=st.sampled_from(["csv", "parquet"]))
def test_no_bytes_break_the_reader(tmp_path_factory, data, ending):
    path = tmp_path_factory.getbasetemp() / f"any.{ending}"
    path.write_bytes(data)
    only_input_errors(path)


@settings(max_examples=60, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), byte=st.integers(0, 255))
@example(0.55078125, 128)  # in the name of a column
@example(569 / 1266, 182)  # pyarrow ends the process when it reads this column's metadata
def test_no_damaged_parquet_breaks_the_reader(tmp_path_factory, place, byte):
    path = tmp_path_factory.getbasetemp() / "damaged.parquet"
    pq.write_table(pa.table({"t": T, "stick": STICK, "phi": PHI}), path)
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] = byte
    path.write_bytes(data)
    only_input_errors(path)


def test_missing_outputs_are_read_and_told(tmp_path):
    text = lines()
    for row, empty in ((3, ""), (7, "nan")):
        text[row + 1] = ",".join([*text[row + 1].split(",")[:2], empty])
    path = tmp_path / "bench.csv"
    path.write_text("\n".join(text))
    flight = read_flight(path, **ASKED)
    assert np.array_equal(np.flatnonzero(np.isnan(flight.outputs["roll"])), [3, 7])
    assert flight.source is not None
    said = [(n.code, n.subjects, n.value) for n in flight.source.notes]
    assert said == [("samples.missing", ("roll",), 2)]
    # On another clock neighbours of a missing sample are missing too; the rest is unchanged.
    near = read_flight(path, **ASKED, rate=60).outputs["roll"]
    assert np.array_equal(np.flatnonzero(np.isnan(near)), [3, 4, 8, 9])
    # Resampling to a much higher rate adds no outputs.
    fast = read_flight(path, **ASKED, rate=100).outputs["roll"]
    assert np.array_equal(np.flatnonzero(~np.isnan(fast)), [0, 2, 4, 8, 10, 12, 16, 18, 20, 22])
    np.testing.assert_allclose(fast[[0, 4, 8, 22]], PHI[[0, 2, 4, 11]], rtol=1e-12)


STEPPED, SMOOTH = np.repeat([0.0, 1.0, -0.4, 0.7, 0.1], 10), np.sin(0.3 * np.arange(50))


def two_sticks(tmp_path, **how):
    path = tmp_path / "two.csv"
    table = np.stack([0.02 * np.arange(50), STEPPED, SMOOTH, np.cos(np.arange(50))], axis=1)
    np.savetxt(path, table, delimiter=",", header="t,a,b,phi", comments="", fmt="%.12g")
    holds = how.pop("holds", {})
    inputs = {n: Signal(n, "1", "1", hold=holds.get(n, "auto")) for n in ("a", "b")}
    phi = {"phi": Signal("phi", "rad", "rad")}
    return read_flight(path, time="t", inputs=inputs, outputs=phi, **how)


def test_the_record_decides_what_inputs_do_between_samples(tmp_path):
    flight = two_sticks(tmp_path)
    assert flight.hold == {"a": "zero-order", "b": "linear"}
    assert flight.hold_reason == {
        "a": "stays for 10 samples at a time and jumps",
        "b": "moves at 100 % of the samples",
    }


def test_what_is_stated_stands(tmp_path):
    flight = two_sticks(tmp_path, holds={"a": "linear", "b": "zero-order"})
    assert flight.hold == {"a": "linear", "b": "zero-order"}
    assert flight.hold_reason == {}


def test_resampling_goes_by_the_hold_of_the_raw_record(tmp_path):
    flight = two_sticks(tmp_path, rate=200.0)
    t, k = flight.times, np.floor(flight.times / 0.02 + 1e-6).astype(int)
    assert flight.hold == {"a": "zero-order", "b": "linear"}
    np.testing.assert_allclose(flight.inputs["a"], STEPPED[k], atol=1e-9)
    np.testing.assert_allclose(
        flight.inputs["b"], np.interp(t, 0.02 * np.arange(50), SMOOTH), atol=1e-9
    )


def test_only_the_window_decides(tmp_path):
    """Test that the stick outside the window has no effect."""
    flight = two_sticks(tmp_path, window=(0.0, 0.17))
    assert flight.hold_reason["a"] == "never moves"


def test_a_clock_in_milliseconds_without_its_unit_is_asked_for_by_it(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,stick,phi\n" + "".join(f"{20 * k},{k % 3},{k % 5}\n" for k in range(60)))
    with pytest.raises(InputError):
        read_flight(path, **ASKED, options=ReadOptions(rate=50.0))
