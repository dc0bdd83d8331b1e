"""Check that kills do not change a study of fits with many starts and records of the bench.

    .venv/bin/python experiments/study_survives.py [FITS] [KILLS]

The same study runs twice on two processes: once undisturbed, and once killed (SIGKILL) KILLS times
at random times and resumed by the same command. The two Datasets must be identical, and no finished
fit may be repeated. Half of the fits have one start and half another. Every record has its own
noise and sticks.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import xarray as xr
import yaml

ROOT = Path(__file__).parents[1]
STARTS = (0.02, 0.05)


def configuration(folder: Path, fits: int) -> Path:
    """Write a study of `fits` fits, two for each record, with its records; return its path."""
    config = {
        "model": "roll-on-stand",
        "vehicle": str(ROOT / "configs" / "vehicles" / "bench-30.yaml"),
        "flights": [
            {
                "log": [f"record-{i:03d}.csv" for i in range(fits // 2)],
                "signals": {
                    "time": {"signal": "t"},
                    "inputs": {"x_roll": {"signal": "stick", "unit": "m"}},
                    "outputs": {"roll": {"signal": "roll", "unit": "rad"}},
                },
            }
        ],
        "fit": {"free": {"Ixx": {"start": STARTS[0]}, "If": {"start": 2e-4}}},
        "rls": None,
        "study": {"fit.free.Ixx.start": list(STARTS)},
    }
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    _records(folder, fits // 2)
    return path


def _records(folder: Path, count: int) -> None:
    import jax
    import jax.numpy as jnp
    import numpy as np

    from heli_jax import load_vehicle, models, naming, simulate
    from heli_jax.simulation.inputs import random_steps

    jax.config.update("jax_enable_x64", True)
    model = models.roll_on_stand
    vehicle = load_vehicle(ROOT / "configs" / "vehicles" / "bench-30.yaml")
    params = model.Params(**{n: getattr(vehicle, n) for n in naming.names(model.Params)})
    run = jax.jit(lambda u: simulate(model, params, model.Inputs(x_roll=u), dt=0.02).outputs.roll)
    t = 0.02 * np.arange(1000)
    for i in range(count):
        rng = np.random.default_rng(i)
        stick = 3e-6 * random_steps(t.size, 0.02, rng, (0.2, 1.5))
        roll = np.asarray(run(jnp.asarray(stick))) + 2e-3 * rng.standard_normal(t.size)
        table = np.column_stack([t, stick, roll])
        name = folder / f"record-{i:03d}.csv"
        np.savetxt(name, table, "%.9g", ",", header="t,stick,roll", comments="")


def command(config: Path, out: Path) -> list[str]:
    program = [sys.executable, "-m", "heli_jax", "fit", str(config)]
    return [*program, "--out", str(out), "--resume", "--workers", "2"]


def finished(out: Path) -> dict[str, int]:
    """Return the finished fits, with marks that change if one is repeated."""
    return {p.parent.name: p.stat().st_ino for p in (out / "fits").glob("[0-9]*/fit.json")}


def carry_out(config: Path, out: Path, until: int | None = None) -> float:
    """Run a study, or kill it after a number of fits; return the seconds."""
    begun = time.monotonic()
    nothing = subprocess.DEVNULL
    with subprocess.Popen(command(config, out), stdout=nothing, stderr=nothing) as run:
        while run.poll() is None and (until is None or len(finished(out)) < until):
            time.sleep(0.05)
        if until is not None:
            time.sleep(random.uniform(0.0, 0.5))
            run.send_signal(signal.SIGKILL)
    if until is None and run.returncode != 0:
        raise SystemExit(f"the study ended with {run.returncode}")
    return time.monotonic() - begun


def opened(out: Path) -> xr.Dataset:
    return xr.open_zarr(out / "study.zarr", consolidated=False, chunks=None).load()


def survives(folder: Path, fits: int, kills: int) -> bool:
    """True if the killed study ends in the same Dataset, without a repeated fit."""
    random.seed(0)
    config = configuration(folder, fits)
    whole, killed = folder / "whole", folder / "killed"
    seconds = carry_out(config, whole)
    print(f"{fits} fits on two processes: {seconds:.0f} s", flush=True)
    begun, again = time.monotonic(), 0
    for k in range(kills):
        before = finished(killed) if killed.exists() else {}
        carry_out(config, killed, until=round(fits * (k + 0.6) / kills))
        again += sum(finished(killed).get(name) != mark for name, mark in before.items())
        print(f"killed with {len(finished(killed))} of {fits} fits", flush=True)
    before = finished(killed)
    carry_out(config, killed)
    again += sum(finished(killed)[name] != mark for name, mark in before.items())
    print(f"with {kills} kills: {time.monotonic() - begun:.0f} s, {again} fits made again")
    first, second = opened(whole), opened(killed)
    same = first.identical(second)
    print(f"Datasets {'identical' if same else 'DIFFER'}")
    statuses, counts = _counted(first)
    print(", ".join(f"{n} {s}" for s, n in zip(statuses, counts, strict=True)))
    return same and not again


def _counted(dataset: xr.Dataset) -> tuple[list[str], list[int]]:
    words = [str(s) for s in dataset["status"].to_numpy().ravel()]
    names = sorted(set(words))
    return names, [words.count(n) for n in names]


def main(fits: int, kills: int) -> None:
    folder = Path(tempfile.mkdtemp(prefix="heli_jax-study-survives-"))
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "compiled"))
    try:
        raise SystemExit(0 if survives(folder, fits, kills) else 1)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "three minutes",
        Size("fits", 200, 6, "fits of the study"),
        Size("kills", 3, 1, "of the study"),
    )
    main(options.fits, options.kills)
