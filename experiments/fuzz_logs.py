"""Robustness against damaged logs: files are truncated, and bytes are flipped, many times.

Every attempt must end in a flight or in one sentence, within ten seconds. Run it on any logs:

    .venv/bin/python experiments/fuzz_logs.py LOG --count 500

It prints the outcomes, the slowest attempt, and the process's largest memory. The exit code is 1
after a traceback or a hang, or if the memory exceeded 1 GB. `--seed` and `--seconds` split a long
run.
"""

import argparse
import collections
import contextlib
import io
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from heli_jax.cli import logs as printed
from heli_jax.errors import InputError
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.describe import describe_flights

LONGEST = 10
"""Longest processor time of one attempt [s]."""
CONVERTED = 25
"""One of this many attempts is also converted."""
MOST = 1000
"""Largest memory for all attempts [MB]."""


class Hung(Exception):
    """An attempt took longer than `LONGEST`."""


def damaged(data: bytes, count: int, seed: int = 0) -> Iterator[tuple[str, bytes]]:
    """Yield descriptions of damage and the damaged bytes: `count` truncations and as many flips."""
    rng = np.random.default_rng(seed)
    # In turn, so that a run that ends early has both.
    for size in rng.integers(0, len(data), count).tolist():
        yield f"cut at {size}", data[:size]
        # A few bytes at a time, since a single one mostly hits samples, which is undetectable.
        flipped = bytearray(data)
        places = rng.integers(0, len(data), int(rng.integers(1, 9))).tolist()
        # Half of them near the start, in headers and formats.
        if rng.random() < 0.5:
            places = [place % min(2000, len(data)) for place in places]
        for place in places:
            flipped[place] ^= int(rng.integers(1, 256))
        yield f"flipped at {places}", bytes(flipped)


def outcome(path: Path, converts: bool = True) -> str:
    """Return `flight`, `noted` (a flight with a stated loss) or `refused`.

    Args:
        path: the file.
        converts: True to convert the flight to one clock too, the slowest part.

    Raises:
        AssertionError: the error is not one sentence, or the text is unsafe for a terminal.
        Hung: it took too long.
    """

    def alarm(*_: object) -> None:
        raise Hung

    before = signal.signal(signal.SIGPROF, alarm)
    # Time of this process, without other load.
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        flights = list(describe_flights(path))
        for flight in flights:
            shown = io.StringIO()
            with contextlib.redirect_stdout(shown):
                printed.print_flights([flight])
            assert "\x1b" not in shown.getvalue()
        printed.as_json(flights)
        if not converts:
            return "noted" if any(f.notes for f in flights) else "flight"
        number = flights[0].flight[0] if flights[0].flight[1] > 1 else None
        converted = convert_log(path, Selection(rate=50.0, flight=number))
        return "noted" if any(f.notes for f in flights) or converted.notes else "flight"
    except InputError as e:
        words = str(e)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
    assert len(words.splitlines()) == 1, words
    assert path.name in words, words
    return "refused"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--count", type=int, help="truncations, and as many flips, of each (500)")
    parser.add_argument("--quick", action="store_true", help="10 of them, to see that it runs")
    parser.add_argument("--seed", type=int, default=0, help="of where the damage is")
    parser.add_argument("--seconds", type=float, default=1e9, help="no attempt begins later")
    options = parser.parse_args()
    count = options.count or (10 if options.quick else 500)
    failed, began_all = False, time.monotonic()
    for log in options.logs:
        counts, slowest = collections.Counter(), (0.0, "")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / log.name
            path.write_bytes(log.read_bytes())
            outcome(path)  # undamaged first, so that imports do not count
            attempts = damaged(log.read_bytes(), count, options.seed)
            for number, (words, data) in enumerate(attempts):
                if time.monotonic() - began_all > options.seconds:
                    break
                path.write_bytes(data)
                began = time.process_time()
                try:
                    # Two consecutive attempts have both kinds of damage.
                    counts[outcome(path, number % (2 * CONVERTED) >= 2 * CONVERTED - 2)] += 1
                except (Exception, Hung) as e:
                    failed = True
                    counts["failed"] += 1
                    print(f"{log.name}, {words}: {type(e).__name__}: {e}"[:400])
                slowest = max(slowest, (time.process_time() - began, words))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        failed |= memory > MOST
        words = ", ".join(f"{n} {what}" for what, n in sorted(counts.items()))
        print(f"{log.name}: {words}; slowest {slowest[0]:.2f} s, {memory:.0f} MB at most")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
