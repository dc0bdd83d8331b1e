"""Commands that write files to begin with, and say what may stand in them."""

import argparse
from collections.abc import Callable
from pathlib import Path

from heli_jax import run_directory
from heli_jax.terminal_table import tell


def new(options: argparse.Namespace, say: Callable[[str], None]) -> int:
    """`heli-jax new`."""
    from heli_jax.new_config import write_config

    log = Path(options.log)
    out = Path(options.out) if options.out else Path(log.stem).with_suffix(".yaml")
    chosen = (options.model, options.vehicle, options.flight, options.time_rate)
    written = write_config(log, out, *chosen)
    for found in written.notes:
        say(found.sentence)
    return 0


def keys(options: argparse.Namespace, say: Callable[[str], None]) -> int:
    """`heli-jax keys`."""
    from heli_jax import reference

    if options.schema is not None:
        place = Path(options.schema)
        run_directory.require_place(place, f"--schema {place}")
        reference.write_schema(place)
        say(f"wrote {place}")
    elif options.fit:
        reference.print_fit_keys(options.pattern, as_json=options.json)
    elif options.json:
        print(reference.as_json(options.pattern))
    else:
        reference.print_keys(options.pattern)
    return 0


def new_model(options: argparse.Namespace, say: Callable[[str], None]) -> int:
    """`heli-jax new-model`."""
    from heli_jax.new_model import write_skeleton

    written = write_skeleton(options.name, options.out)
    tell("\n".join(map(str, written)))
    say(
        f"wrote {len(written)} files; next: heli-jax simulate {written[2]} --out "
        f"{written[2].with_suffix('.csv')}, then heli-jax fit {written[2]}"
    )
    return 0
