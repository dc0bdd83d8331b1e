"""Check that a sweep killed many times ends with the same numbers as one without kills.

`python experiments/sweep_survives.py 20` runs `heli-jax sweep` to its end, then the same sweep with
20 `kill -9` at random times, each followed by `--resume`. It compares every bit of the stores, and
checks that no finished chunk was written again. It takes two minutes on two free cores.
"""

import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zarr

CONFIG = """
model: roll-on-stand
vehicle: {vehicle}
simulate:
  duration: {duration}
  rate: 50
  inputs: {{x_roll: {{amplitude: 3.0, unit: um}}}}
sweep:
  design: sobol
  n: {n}
  axes:
    Ixx: {{lower: 0.01, upper: 0.1, scale: log}}
    If: {{lower: 1.0e-4, upper: 1.0e-3, scale: log}}
  reduce:
    rms_roll: {{signal: roll, how: rms}}
    last_roll: {{signal: roll, how: final}}
  solver: rk4
  chunk: {chunk}
  lanes: 64
"""
VEHICLE = Path(__file__).parents[1] / "configs" / "vehicles" / "bench-30.yaml"


class Survived(NamedTuple):
    """Effects of the kills."""

    kills: int
    hit: int
    """Kills between the first and the last chunk of a sweep."""
    resumed: int
    """Restarts of the sweep."""
    rewritten: int
    """Finished chunks that were written again."""
    equal: bool
    """True if every array equals that of the run without kills."""


def configuration(folder: Path, n: int = 81920, chunk: int = 512, duration: float = 60.0) -> Path:
    path = folder / "sweep.yaml"
    path.write_text(CONFIG.format(vehicle=VEHICLE, n=n, chunk=chunk, duration=duration))
    return path


def command(config: Path, out: Path) -> list[str]:
    program = [sys.executable, "-m", "heli_jax", "sweep", str(config), "--out", str(out)]
    return [*program, "--resume", "--no-figures"]


def finished(out: Path) -> dict[str, tuple[int, int]]:
    """Return the status files of finished chunks, with marks that change if one is rewritten."""
    marks = {}
    for path in (out / "sweep.zarr" / "status" / "c").glob("*"):
        if path.suffix != ".partial":
            stat = path.stat()
            marks[path.name] = (stat.st_mtime_ns, stat.st_ino)
    return marks


def same(a: Path, b: Path) -> bool:
    """True if two stores have the same bits."""
    first, second = zarr.open_group(str(a), mode="r"), zarr.open_group(str(b), mode="r")
    left: dict[str, bytes] = {n: np.asarray(v[...]).tobytes() for n, v in first.arrays()}
    right: dict[str, bytes] = {n: np.asarray(v[...]).tobytes() for n, v in second.arrays()}
    return left == right


def run_through(config: Path, out: Path) -> float:
    """Run the sweep without a kill; return the time to its first finished chunk [s]."""
    begin = time.monotonic()
    with subprocess.Popen(command(config, out)) as run:
        while run.poll() is None and not finished(out):
            time.sleep(0.002)
        first = time.monotonic() - begin
    if run.returncode != 0:
        raise SystemExit(f"the sweep without a kill ended with {run.returncode}")
    return first


def kills(
    config: Path, whole: Path, out: Path, times: int, first: float, seed: int = 0
) -> Survived:
    """Kill the sweep `times` times, then let it end.

    Half of the kills come after some more chunks, the others at random times up to shortly after
    the first chunk. `first` is the time to that [s].
    """
    rng, chunks = random.Random(seed), len(finished(whole))
    hit = rewritten = starts = 0
    done: dict[str, tuple[int, int]] = {}

    def checked() -> None:
        nonlocal done, rewritten
        now = finished(out)
        rewritten += sum(now.get(name) != mark for name, mark in done.items())
        done = now

    for k in range(times):
        with subprocess.Popen(command(config, out), stderr=subprocess.DEVNULL) as run:
            starts += 1
            target = len(done) + rng.randint(1, max(1, chunks // (2 * times)))
            until = time.monotonic() + (rng.uniform(0.0, 1.1 * first) if k % 2 else 120.0)
            while run.poll() is None and time.monotonic() < until:
                if k % 2 == 0 and len(finished(out)) >= target:
                    break
                time.sleep(0.002)
            time.sleep(rng.uniform(0.0, 0.05))
            run.send_signal(signal.SIGKILL)
        checked()
        hit += 0 < len(done) < chunks
    starts += 1
    subprocess.run(
        command(config, out), check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    checked()
    equal = same(whole / "sweep.zarr", out / "sweep.zarr")
    return Survived(times, hit, starts - 1, rewritten, equal)


def main(times: int) -> None:
    folder = Path(tempfile.mkdtemp(prefix="heli_jax-survives-"))
    try:
        config = configuration(folder)
        run_through(config, folder / "whole")
        # Run again with JAX's compilation cache, as the killed sweeps do.
        first = run_through(config, folder / "again")
        outcome = kills(config, folder / "whole", folder / "killed", times, first)
        print(
            f"{outcome.kills} kills, {outcome.hit} of them between the first chunk and the last, "
            f"{outcome.resumed} resumed: bits {'equal' if outcome.equal else 'DIFFER'}, "
            f"{outcome.rewritten} finished chunks written again"
        )
        raise SystemExit(0 if outcome.equal and not outcome.rewritten else 1)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    from script import Size, asked

    main(asked(__doc__, "two minutes", Size("kills", 20, 2, "of the sweep")).kills)
