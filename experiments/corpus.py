"""Regression corpus: a fixed set of cases, their stored results, and changes.

    .venv/bin/python experiments/corpus.py [--store | --compare | --matrix] [--quick] [--only WORDS]

Each case records exit code, status, adequacy, estimates with sd and interval, log-likelihood, codes
of the findings and processor time. `--store` writes them to tests/reference/corpus.json.
`--compare`, the default, prints differences from that file (estimates by more than 0.1 sd, sd by
more than 5 %, status, exit code, adequacy, codes). It ends with exit code 1 if there are any.
`--matrix` prints which diagnostics fire in which cases, and what changes if a candidate of
corpus_matrix.py is disabled. Cases whose files are absent (`--shared DIR`) are skipped with a
reason.
"""

import argparse
import contextlib
import io
import json
import math
import multiprocessing
import os
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]
STORED = ROOT / "tests" / "reference" / "corpus.json"

MOVED, SD_CHANGED, NUMBER_CHANGED = 0.1, 0.05, 1e-3
"""Least changes that count: of an estimate [sd], an sd [relative], a number without sd [relative].
"""
DIGITS = 6
"""Significant digits in the file."""
MAPPED = 42_000
"""Memory regions above which compiled programs are released; Linux allows 65530 per process."""
Result = dict[str, Any]
"""Result of a case, plain data."""


def code_of(finding: Any, names: Iterable[str] = ()) -> str:
    """Return the stable key of a finding, a note or a doubt.

    It is the `code` if there is one. Otherwise it is the sentence without numbers, quoted text,
    paths and names of signals and parameters, which vary between records.
    """
    if isinstance(finding, Mapping):
        code, words = finding.get("code"), finding.get("sentence", "")
        topic = f"{finding['topic']}: " if "topic" in finding else ""
    else:
        code, topic = getattr(finding, "code", None), ""
        words = getattr(finding, "sentence", None) or str(finding)
    if code:
        return str(code)
    words = re.sub(r"'[^']*'|\"[^\"]*\"|`[^`]*`|\S*/\S+", "_", " ".join(words.split()))
    # A parameter `a` is also a word in most sentences.
    known = sorted({n for n in names if len(n) > 1 or n not in "aI"}, key=len, reverse=True)
    if known:
        words = re.sub(rf"(?<![\w.])({'|'.join(map(re.escape, known))})(?![\w])", "_", words)
    words = re.sub(r"[-+]?\d[\d.,]*(e[-+]?\d+)?\b", "#", words)
    words = re.sub(r"(_|flight #)((, | and | or | to )(_|flight #))*", "_", words)
    return topic + re.sub(r"^_: ", "", words)[:60].strip()


def of_fit(content: Mapping[str, Any], code: int) -> Result:
    """Return the stored result of a fit.

    Args:
        content: content of its fit.json.
        code: the exit code.
    """
    findings = content["findings"]
    verdict = content["verdict"]
    exits = [] if content["status"] == "converged" else [f"exit {content['status']}"]
    exits += ["exit other solutions"] if verdict["other_solutions"] else []
    exits += [f["code"] for f in findings if f["denies"]]
    exits += [distrust["code"] for distrust in content["untrusted"].values()]
    doubts = [f["code"] for f in findings if f["severity"] in ("doubt", "refuse")]
    notes = [f["code"] for f in findings if f["severity"] == "note"]
    further = (content["intervals"] or {}).get("by_parameter", {})
    estimates = {
        n: [e["value"], e["sd"], e["lower95"], e["upper95"]]
        for n, e in content["parameters"].items()
        if not e["fixed"]
    }
    for c in content["determined_combinations"]:
        estimates[c["name"]] = [c["value"], c["sd"], c["lower95"], c["upper95"]]
    for name, by in further.items():
        # Ends are converted to a normal distribution, so that one rule compares all intervals.
        for method, (low, high) in by.items():
            estimates[f"{name} by {method}"] = [(low + high) / 2, (high - low) / 3.92, low, high]
    return {
        "exit": code,
        "status": content["status"],
        "adequate": content["adequate"],
        "untrusted": list(content["untrusted"]),
        "estimates": estimates,
        "log_likelihood": content["log_likelihood"],
        "codes": coded(exits, doubts, notes),
    }


def coded(*by_rank: Iterable[str]) -> dict[str, list[str]]:
    """Group codes by effect: `exit` changes the exit code, `doubt` the trust, `note` nothing."""
    ranks, seen, out = ("exit", "doubt", "note"), set(), {}
    for rank, codes in zip(ranks, by_rank, strict=False):
        out[rank] = sorted({*codes} - seen)
        seen |= {*codes}
    return {rank: codes for rank, codes in out.items() if codes}


def run(case: Any) -> Result:
    """Run one case in an empty folder of its own."""
    began = processor_time()
    with tempfile.TemporaryDirectory(prefix="corpus-") as folder:
        quiet = contextlib.redirect_stdout(io.StringIO())
        try:
            with quiet, contextlib.chdir(folder):
                result = case.run(Path(folder))
        except LookupError as e:
            if type(e) is not LookupError:
                raise
            result = {"skipped": str(e.args[0])}
    return rounded({**result, "cpu": round(processor_time() - began, 1)})


def processor_time() -> float:
    """Return the processor time of this process and its finished children [s]."""
    return sum(os.times()[:4])


def rounded(value: Any) -> Any:
    """Return the value with few digits, and None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


Entry = tuple[str, str]
"""A case, and its way: `` is unchanged, others are in `corpus_matrix.way`."""


def run_group(
    entries: Sequence[Entry], shared: str, way: Callable[[str], Any] | None = None
) -> list[tuple[Entry, Result]]:
    """Run the cases of one process one after another, so that they share compiled programs.

    Args:
        entries: cases, and their ways.
        shared: folder of records outside the project.
        way: function from the name of a way to the context of a case, which yields additions to its
            result.
    """
    import jax
    from corpus_cases import cases

    from heli_jax.cli.jax_settings import prepare_jax

    # 64 bit before any trace, since cases of Problems do not use the command line.
    prepare_jax()
    known, done = {c.name: c for c in cases(Path(shared))}, []
    for name, how in entries:
        with way(how) if way and how else contextlib.nullcontext({}) as added:
            try:
                result = run(known[name])
            except Exception:
                # A bug of ours is a result too, which differs from the stored one.
                result = {"failed": traceback.format_exc().strip().splitlines()[-1]}
        done.append(((name, how), {**result, **added}))
        print(
            f"{name} {how}: {in_words(result)}",
            file=sys.stderr,
            flush=True,
        )
        maps = Path("/proc/self/maps")
        if maps.exists() and maps.read_bytes().count(b"\n") > MAPPED:
            jax.clear_caches()
    return done


def in_words(result: Result) -> str:
    """Return a result in one line."""
    for key in ("skipped", "failed"):
        if key in result:
            return f"{key}: {result[key]}"
    told = [result.get(k) for k in ("status", "wrong") if result.get(k)]
    fine = {True: "adequate", False: "not adequate", None: ""}[result.get("adequate")]
    return ", ".join(filter(None, [f"exit {result['exit']}", *told, fine, f"{result['cpu']} s"]))


def run_all(chosen: Sequence[Any], shared: Path, jobs: int) -> dict[str, Result]:
    """Run all cases unchanged, in the order of the list."""
    results = run_entries([(case, "") for case in chosen], shared, jobs)
    return {case.name: results[case.name, ""] for case in chosen}


def run_entries(
    entries: Sequence[tuple[Any, str]],
    shared: Path,
    jobs: int,
    way: Callable[[str], Any] | None = None,
) -> dict[Entry, Result]:
    """Run cases in ways, each group in a process of its own."""
    groups: dict[str, list[Entry]] = {}
    for case, how in entries:
        groups.setdefault(case.group, []).append((case.name, how))
    arguments = [(group, str(shared), way) for group in groups.values()]
    if jobs == 1:
        done = [run_group(*each) for each in arguments]
    else:
        # Each group's process ends with its memory and compiled programs.
        with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=1) as pool:
            done = pool.starmap(run_group, arguments, chunksize=1)
    return dict(one for group in done for one in group)


def differences(before: Result, after: Result) -> Iterator[str]:
    """Yield the differences of a case, a line each."""
    # Cases cannot be compared if their files are absent, now or when results were stored.
    if "skipped" in before or "skipped" in after:
        return
    if "failed" in before or "failed" in after:
        if before.get("failed") != after.get("failed"):
            yield f"failed: {before.get('failed')} -> {after.get('failed')}"
        return
    for key in ("exit", "status", "adequate", "untrusted", "wrong"):
        if before.get(key) != after.get(key):
            yield f"{key}: {before.get(key)} -> {after.get(key)}"
    yield from _differing_numbers(before, after)
    old, new = (
        {f"{rank} [{code}]" for rank, codes in r.get("codes", {}).items() for code in codes}
        for r in (before, after)
    )
    yield from (f"no longer said: {code}" for code in sorted(old - new))
    yield from (f"newly said: {code}" for code in sorted(new - old))


def _differing_numbers(before: Result, after: Result) -> Iterator[str]:
    old, new = before.get("estimates", {}), after.get("estimates", {})
    for name in [*old, *(n for n in new if n not in old)]:
        if name not in old or name not in new:
            yield f"{name}: {'no longer' if name in old else 'newly'} estimated"
            continue
        (a, sd, *_), (b, other, *_) = old[name], new[name]
        if (sd is None) != (other is None):
            yield f"{name}: sd {sd} -> {other}"
        elif sd is not None and sd > 0:
            if a is None or b is None or not abs(b - a) <= MOVED * sd:
                yield f"{name}: {a} -> {b} ({((b or 0) - (a or 0)) / sd:+.2g} sd)"
            if not abs(other - sd) <= SD_CHANGED * sd:
                yield f"{name}: sd {sd} -> {other}"
    old, new = before.get("numbers", {}), after.get("numbers", {})
    for name in sorted({*old, *new}):
        a, b = old.get(name), new.get(name)
        if isinstance(a, float | int) and isinstance(b, float | int):
            if not abs(b - a) <= NUMBER_CHANGED * max(abs(a), abs(b)):
                yield f"{name}: {a} -> {b}"
        elif a != b:
            yield f"{name}: {a} -> {b}"


def compare(stored: Mapping[str, Result], now: Mapping[str, Result]) -> list[str]:
    """Return all differences, and the names of cases that are not stored."""
    lines = []
    for name, result in now.items():
        if name not in stored:
            lines.append(f"{name}: is not in the stored file")
            continue
        lines += [f"{name}: {line}" for line in differences(stored[name], result)]
    return lines


def store(results: Mapping[str, Result]) -> None:
    """Write the file with a line for each case, so that changes are visible."""
    rows = [f"{json.dumps(name)}: {json.dumps(r, sort_keys=True)}" for name, r in results.items()]
    text = "{\n" + ",\n".join(rows) + "\n}\n"
    STORED.parent.mkdir(exist_ok=True)
    STORED.write_text(text, encoding="utf-8")
    print(f"{len(results)} cases, {len(text) / 1e3:.0f} kB: {STORED.relative_to(ROOT)}")


def shared_folder(stated: str | None) -> Path:
    """Return the folder of records outside the project."""
    return Path(stated or os.environ.get("HELI_JAX_SHARED") or ROOT.parent / "shared").absolute()


def main() -> int:
    """Run the requested command; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--store", action="store_true", help="keep the results as the right ones")
    what.add_argument("--compare", action="store_true", help="with the stored ones (default)")
    what.add_argument("--matrix", action="store_true", help="diagnostic by case, and ablations")
    what.add_argument("--list", action="store_true", help="names of the cases")
    parser.add_argument("--quick", action="store_true", help="ten cases")
    parser.add_argument("--only", default="", help="cases whose name has these words in it")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    parser.add_argument("--shared", help="folder of records ($HELI_JAX_SHARED, ../shared)")
    options = parser.parse_args()
    from corpus_cases import cases

    shared = shared_folder(options.shared)
    chosen = [c for c in cases(shared) if options.only in c.name and (c.quick or not options.quick)]
    if options.list:
        print("\n".join(c.name for c in chosen))
        return 0
    if options.matrix:
        from corpus_matrix import matrix

        print(matrix(chosen, shared, options.jobs))
        return 0
    if not (options.store or STORED.exists()):
        print(f"{STORED} is absent: --store writes it", file=sys.stderr)
        return 2
    if options.store and (options.quick or options.only):
        parser.error("--store: expected all cases, so that the file is whole")
    began = time.perf_counter()
    now = run_all(chosen, shared, options.jobs)
    cpu = sum(r.get("cpu", 0.0) for r in now.values())
    print(f"{len(now)} cases, {cpu:.0f} s of processor time, {time.perf_counter() - began:.0f} s")
    skipped = [f"{name}: {r['skipped']}" for name, r in now.items() if "skipped" in r]
    print("\n".join(f"skipped: {line}" for line in skipped))
    if options.store:
        store(now)
        return 0
    lines = compare(json.loads(STORED.read_text(encoding="utf-8")), now)
    print("\n".join(lines) or "nothing differs")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
