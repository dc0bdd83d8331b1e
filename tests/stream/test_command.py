"""`heli-jax stream` from its source to the report."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import load_config, load_fit
from heli_jax.cli import main
from heli_jax.cli.stream import Follower, received
from heli_jax.cli.wanted import Wanted, wanted_of
from heli_jax.errors import InputError
from heli_jax.flights import Signal

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Path of the demo's configuration with a log of 44 s."""
    folder = tmp_path_factory.mktemp("bench")
    content = yaml.safe_load((ROOT / "configs" / "bench-roll.yaml").read_text())
    content["vehicle"] = str(ROOT / "configs" / "vehicles" / "bench-30.yaml")
    content["flights"][0]["log"] = "bench.csv"
    content["simulate"] |= {"duration": 44, "rate": 50}
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    assert main(["simulate", str(path), "--out", str(folder / "bench.csv")]) == 0
    return path


def estimates_in(folder):
    return {n: e.value for n, e in load_fit(folder).estimates.items()}


def test_a_damaged_stream_ends_as_the_fit_of_the_log(bench, tmp_path, capsys):
    head, *rows = (bench.parent / "bench.csv").read_text().splitlines(keepends=True)
    rng = np.random.default_rng(0)
    twice = [*enumerate(rows), *enumerate(rows[::5])]
    times = [i + 40.0 * rng.uniform() for i, _ in twice[: len(rows)]]
    times += [5 * i + 40.0 * rng.uniform() for i, _ in twice[len(rows) :]]
    mixed = [twice[k][1] for k in np.argsort(times)]
    (tmp_path / "mixed.csv").write_text(head + "".join(mixed) + "44.0,0.00")
    how = ["--until-end", "--from", str(tmp_path / "mixed.csv"), "--for", "a/Ixx=2%"]
    assert main(["stream", str(bench), *how, "--out", str(tmp_path / "run")]) == 0
    shown = capsys.readouterr().out
    assert "2 %" in shown
    assert f"{len(rows[::5])} repeated" in shown
    assert (tmp_path / "run.csv").read_text() == head + "".join(rows)
    assert main(["fit", str(bench), "--out", str(tmp_path / "fit")]) == 0
    ours, batch = (estimates_in(tmp_path / n) for n in ("run", "fit"))
    assert ours == pytest.approx(batch, rel=1e-12)


def followed(experiment, log, lines):
    """Return the follower of lines of a table, which come in pieces."""
    follower = Follower(experiment, "stream.csv", log, 12.0)
    for part in np.array_split(np.array(lines, object), 9):
        follower.take("".join(part).encode())
        follower.update()
    follower.finish()
    follower.update(last=True)
    one, true = follower.known.estimates["Ixx"], float(experiment.vehicle.params.Ixx)
    assert abs(one.value - true) < 3.0 * one.sd
    return follower.state


def test_a_gap_costs_its_block_alone(bench, tmp_path):
    head, *rows = (bench.parent / "bench.csv").read_text().splitlines(keepends=True)
    # 1.2 s are lost in the second block, and the next one begins after them.
    lines = [head, *rows[:700], *rows[760:]]
    state = followed(load_config(bench), tmp_path / "run.csv", lines)
    assert (int(state.samples), int(state.missing)) == (len(rows) - 59, 1)
    assert int(state.blocks) == 3


def test_clocks_of_two_messages(bench, tmp_path):
    head, *rows = (bench.parent / "bench.csv").read_text().splitlines(keepends=True)
    cells = [row.rstrip().split(",") for row in rows]
    # The output is logged 3 ms after the input, in a row of its own.
    lines = [f"{t},{u},\n{float(t) + 0.003:.4f},,{y}\n" for t, u, y in cells]
    experiment = load_config(bench, {"flights.0.rate": 50})
    state = followed(experiment, tmp_path / "run.csv", [head, *lines])
    assert int(state.samples) == pytest.approx(len(rows), abs=2)
    assert (int(state.missing), int(state.blocks)) == (0, 3)


@pytest.mark.parametrize(
    ("change", "how"),
    [
        (lambda t: t, ["--for", "Ixx"]),
        (lambda t: t, ["--for", "nothing=2%"]),
        (lambda t: t.replace("phi", "other"), []),
        (lambda t: t.replace("\n3,", "\n\x1b[31m,"), []),
        (lambda t: "", []),
        (lambda t: t[:200], []),
    ],
)
def test_wrong_input_ends_in_one_sentence(bench, tmp_path, capsys, change, how):
    path = tmp_path / "log.csv"
    path.write_text(change((bench.parent / "bench.csv").read_text()))
    how = [*how, "--until-end", "--from", str(path), "--out", str(tmp_path / "run")]
    assert main(["stream", str(bench), *how]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "\x1b" not in error


def test_wanted_sds():
    assert wanted_of(["a=2%", "a/Ixx=0.5"]) == {
        "a": Wanted(0.02, True),
        "a/Ixx": Wanted(0.5, False),
    }
    assert Wanted(0.02, True).reached(-5.0, 0.09)
    assert not Wanted(0.02, False).reached(5.0, 0.09)
    for text in ("a", "a=", "a=0", "a=-1", "a=1.2.3", "=2%"):
        with pytest.raises(InputError):
            wanted_of([text])


def test_messages_become_rows(tmp_path):
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    link = mavlink.MAVLink(io.BytesIO())
    with (tmp_path / "flight.tlog").open("wb") as file:
        for k in range(5):
            stamp = struct.pack(">Q", 1_700_000_000_000_000 + 20_000 * k)
            for message in (
                mavlink.MAVLink_attitude_message(20 * k, 0.1 * k, 0.0, 0.0, 0.5, 0.0, 0.0),
                mavlink.MAVLink_rc_channels_message(20 * k + 5, 1, 1500 + k, *[0] * 17, 255),
            ):
                file.write(stamp + message.pack(link))
    names = ["RC_CHANNELS.chan1_raw", "ATTITUDE.roll"]
    time = Signal("time", "ms", "s")
    rows = received(f"mavlink:{tmp_path / 'flight.tlog'}", True, lambda: False, time, names)
    lines = b"".join(rows).decode().splitlines()
    assert lines[0] == "time,RC_CHANNELS.chan1_raw,ATTITUDE.roll"
    cells = [line.split(",") for line in lines[1:]]
    assert [float(c[0]) for c in cells] == pytest.approx([0, 5, 20, 25, 40, 45, 60, 65, 80, 85])
    assert [float(c[2]) for c in cells[::2]] == pytest.approx(0.1 * np.arange(5))
    assert [float(c[1]) for c in cells[1::2]] == [1500, 1501, 1502, 1503, 1504]
