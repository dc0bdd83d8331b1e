"""Coverage of the 95 % intervals, and accuracy of the reported standard deviations.

    .venv/bin/python experiments/coverage.py [--runs N | --quick] [--only WORDS] [--out FOLDER]

Many records of each case in experiments/coverage_cases are fitted one by one; each case runs at its
full size unless N is given. FOLDER (runs/coverage) stores a line for each run, so that an
interrupted study can continue; table.md covers all runs.
"""

import argparse
import dataclasses
import importlib
import json
import pkgutil
import re
import sys
import time
from pathlib import Path

import coverage_cases
import jax
import numpy as np
from coverage_cases import Case, Interval, Run

jax.config.update("jax_enable_x64", True)
QUICK = 2
"""Runs of each case with --quick."""


def all_cases() -> list[Case]:
    cases = []
    for module in pkgutil.iter_modules(coverage_cases.__path__):
        cases += importlib.import_module(f"coverage_cases.{module.name}").cases()
    return cases


def run_case(case: Case, runs: int, folder: Path) -> list[Run]:
    """Return the runs of seeds 0 to runs - 1; stored ones are read from file."""
    log = folder / (re.sub(r"\W+", "-", case.name) + ".jsonl")
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    done = {}
    for line in lines:
        record = json.loads(line)
        seed = record.pop("seed")
        record["parameters"] = {n: Interval(*v) for n, v in record["parameters"].items()}
        done[seed] = Run(**record)
    begin = time.monotonic()
    for seed in range(runs):
        if seed in done:
            continue
        done[seed] = case.one_run(seed)
        with log.open("a", encoding="utf-8") as f:
            f.write(json.dumps({"seed": seed, **dataclasses.asdict(done[seed])}) + "\n")
        if seed % 10 == 9 or seed == runs - 1:
            seconds = time.monotonic() - begin
            print(
                f"{case.name}: {seed + 1} of {runs}, {seconds:.0f} s", file=sys.stderr, flush=True
            )
    return [done[s] for s in range(runs)]


HEAD = "| case | parameter | runs | mean error | reported/real sd | coverage | not converged |"


def rows(case: Case, runs: list[Run]) -> list[str]:
    """Return a line for each parameter, then one for events that must not happen."""
    good = [r for r in runs if r.status != "not-converged"]
    failures, lines = len(runs) - len(good), []
    names = list(dict.fromkeys(n for r in good for n in r.parameters))
    for name in names:
        intervals = [r.parameters[name] for r in good if name in r.parameters]
        error = np.array([i.value - i.truth for i in intervals])
        real = error.std(ddof=1) if error.size > 1 else np.nan
        # The median, so that one run with a huge sd does not dominate.
        reported = np.median([i.sd for i in intervals])
        covered = np.mean([i.lower < i.truth < i.upper for i in intervals])
        lines.append(
            f"| {case.name} | {name} | {len(intervals)} | {error.mean() / real:+.2f} sd "
            f"| {reported / real:.2f} | {100 * covered:.1f} % | {failures} |"
        )
    flags = dict.fromkeys(n for r in runs for n in r.flags)
    for name in flags:
        count = sum(r.flags.get(name, False) for r in runs)
        lines.append(f"| {case.name} | {name}: {count} of {len(runs)} | | | | | {failures} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="At full size: an hour on two cores.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--runs", type=int, help="runs of each case, instead of its full size")
    parser.add_argument(
        "--quick", action="store_true", help=f"{QUICK} runs of each case, to see that it runs"
    )
    parser.add_argument("--only", default="", help="cases whose name has these words in it")
    parser.add_argument("--out", type=Path, default=Path("runs/coverage"))
    options = parser.parse_args()
    runs = options.runs or (QUICK if options.quick else None)
    options.out.mkdir(parents=True, exist_ok=True)
    lines = [HEAD, "|" + "---|" * 7]
    for case in all_cases():
        if options.only in case.name:
            lines += rows(case, run_case(case, runs or case.runs, options.out))
    text = "\n".join(lines) + "\n"
    (options.out / "table.md").write_text(text, encoding="utf-8")
    print(text, end="")


if __name__ == "__main__":
    main()
