"""Cases in which each diagnostic fires, and the loss without it: `corpus.py --matrix`.

The first table has a row for each code. It counts the sound and unsound cases in which it fires. It
also counts sound cases that end with an exit code other than 0 or not adequate. Finally it counts
unsound cases without another finding of its rank or above. The second has a row for each candidate
for deletion: where its entry function returns something, and what changes without it. Changes
concern exit code, status, adequacy, estimates and right answers.
"""

import contextlib
import functools
import importlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from corpus import Result, differences, run_entries

_IDENTIFICATION = "heli_jax.identification"
_VALIDATION = f"{_IDENTIFICATION}.validation"


class Ablation(NamedTuple):
    """A candidate for deletion, and its neutral result."""

    name: str
    entry: str
    """Entry as module:function, or module:Class.method."""
    neutral: Callable[..., Any]
    """Function of the same arguments that returns the neutral result."""


def _untied(valley: Any, null: Any, covariance: Any, unknowns: Any) -> Any:
    """Return the result from slopes alone, without values far from the optimum."""
    from heli_jax.identification.identifiability.equivalents import combinations

    return combinations(null, covariance, unknowns)


ABLATIONS: tuple[Ablation, ...] = (
    Ablation(
        "corrections",
        f"{_IDENTIFICATION}.estimation.noise_scales:first_corrections",
        lambda problem: (),
    ),
    Ablation(
        "swapped_modes",
        f"{_IDENTIFICATION}.identifiability.equivalents:second_solutions",
        lambda *_, **__: (),
    ),
    Ablation(
        "valley",
        f"{_IDENTIFICATION}.identifiability.equivalents:Valley.determined_combinations",
        _untied,
    ),
)


@contextlib.contextmanager
def replaced(entry: str, make: Callable[[Callable[..., Any]], Any]) -> Iterator[None]:
    """Replace an entry function wherever the package has imported it.

    Args:
        entry: entry of an Ablation.
        make: function from the original to its replacement.
    """
    home, _, name = entry.partition(":")
    module: Any = importlib.import_module(home)
    if "." in name:
        owner, name = name.split(".")
        of = getattr(module, owner)
        original = getattr(of, name)
        setattr(of, name, make(original))
        try:
            yield
        finally:
            setattr(of, name, original)
        return
    original = getattr(module, name)
    other = make(original)
    _everywhere(original, other)
    try:
        yield
    finally:
        # Modules imported meanwhile also have the replacement.
        _everywhere(other, original)


def _everywhere(old: Any, new: Any) -> None:
    for module in list(sys.modules.values()):
        if getattr(module, "__name__", "").startswith("heli_jax"):
            for name, value in list(vars(module).items()):
                if value is old:
                    setattr(module, name, new)


def same(a: Any, b: Any) -> bool:
    """True if two results are equal, whatever their types."""
    if a is b:
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return bool(np.array_equal(a, b))
    if type(a) is type(b) and isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    try:
        return bool(a == b)
    except (TypeError, ValueError):
        return False


@contextlib.contextmanager
def way(name: str) -> Iterator[Result]:
    """Change the package while a case runs; yield additions to its result.

    Args:
        name: `record` notes which candidates fire and their time; a candidate's name disables it.
    """
    added: Result = {}
    if name != "record":
        [one] = [a for a in ABLATIONS if a.name == name]
        with replaced(one.entry, lambda _: one.neutral):
            yield added
        return
    fired, spent = set(), {}

    def recording(one: Ablation, original: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(original)
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            began = time.process_time()
            result = original(*args, **kwargs)
            spent[one.name] = spent.get(one.name, 0.0) + time.process_time() - began
            if not same(result, one.neutral(*args, **kwargs)):
                fired.add(one.name)
            return result

        return wrapper

    with contextlib.ExitStack() as stack:
        for one in ABLATIONS:
            stack.enter_context(replaced(one.entry, functools.partial(recording, one)))
        yield added
    added |= {"fired": sorted(fired), "spent": {n: round(s, 2) for n, s in spent.items()}}


def matrix(cases: Sequence[Any], shared: Path, jobs: int) -> str:
    """Return both tables, and the cases without an expected finding."""
    entries = [(c, "record") for c in cases]
    plain = {c: r for (c, _), r in run_entries(entries, shared, jobs, way).items()}
    again = [(c, name) for c in cases for name in plain[c.name].get("fired", ())]
    without = run_entries(again, shared, jobs, way)
    parts = [
        "Codes\n",
        *firing_table(cases, plain),
        "\nCandidates\n",
        *ablation_table(cases, plain, without),
        "\nSilent where something should be said, and wrong otherwise\n",
        *silences(cases, plain),
    ]
    return "\n".join(parts)


def _is_bad(result: Result) -> bool:
    return bool(result.get("exit")) or result.get("adequate") is False


def _silent(case: Any, result: Result) -> bool:
    """True if an unsound case lacks every expected code."""
    said = [code for codes in result.get("codes", {}).values() for code in codes]
    return not any(word in code for word in case.ought for code in said)


def firing_table(cases: Sequence[Any], results: Mapping[str, Result]) -> list[str]:
    """Return a row per code: rank, sound cases, wrong ones, unsound cases, alone, expected."""
    ranks = ("exit", "doubt", "note")
    rows: dict[str, list[int]] = {}
    where: dict[str, str] = {}
    for case in cases:
        by_rank = results[case.name].get("codes", {})
        for i, rank in enumerate(ranks):
            for code in by_rank.get(rank, ()):
                key = f"{rank:5s} {code}"
                row = rows.setdefault(key, [0, 0, 0, 0, 0])
                as_strong = sum(len(by_rank.get(r, ())) for r in ranks[: i + 1])
                if case.sound is True:
                    row[0] += 1
                    row[1] += _is_bad(results[case.name])
                elif case.sound is False:
                    row[2] += 1
                    row[3] += as_strong == 1
                else:
                    row[4] += 1
                where.setdefault(key, case.name)
    head = f"{'sound':>5} {'wrong':>5} {'bad':>5} {'alone':>5} {'other':>5}  rank  code; first case"
    order = sorted(rows, key=lambda k: (ranks.index(k.split()[0]), -sum(rows[k])))
    return [head, *(f"{' '.join(f'{n:5d}' for n in rows[k])}  {k}; {where[k]}" for k in order)]


def ablation_table(
    cases: Sequence[Any],
    plain: Mapping[str, Result],
    without: Mapping[tuple[str, str], Result],
) -> list[str]:
    """Return a row for each candidate, and a line for each changed case."""
    lines = []
    known = {c.name: c for c in cases}
    for one in ABLATIONS:
        ran = [n for n, r in plain.items() if one.name in r.get("spent", {})]
        seconds = sum(plain[n]["spent"][one.name] for n in ran)
        at = [n for (n, name) in without if name == one.name]
        kinds = [known[n].sound for n in at]
        lines.append(
            f"{one.name}: asked in {len(ran)} cases ({seconds:.0f} s), fires in {len(at)}: "
            f"{kinds.count(True)} sound, {kinds.count(False)} unsound, {kinds.count(None)} other"
        )
        for name in at:
            before, after = plain[name], without[name, one.name]
            changed = [
                line
                for line in differences(before, after)
                if not line.startswith(("newly said: note", "no longer said: note"))
            ]
            rank = {"wrong without it": (not before.get("wrong") and after.get("wrong"))}
            rank |= {"right without it": (before.get("wrong") and not after.get("wrong"))}
            verdict = "; ".join(k for k, v in rank.items() if v)
            sound = {True: "sound", False: "unsound", None: "other"}[known[name].sound]
            told = "; ".join(changed) or "notes alone"
            lines.append(f"    {name} ({sound}): {f'[{verdict}] ' if verdict else ''}{told}")
    return lines


def silences(cases: Sequence[Any], results: Mapping[str, Result]) -> list[str]:
    """Return cases with a wrong answer, or without the expected code."""
    lines = []
    for case in cases:
        result = results[case.name]
        if "skipped" in result:
            continue
        if case.sound is False and _silent(case, result):
            ends = f"exit {result.get('exit')}, adequate {result.get('adequate')}"
            lines.append(f"silent: {case.name}: none of {', '.join(case.ought)}; {ends}")
        lines += [f"{k}: {case.name}: {result[k]}" for k in ("wrong", "failed") if result.get(k)]
    return lines


if __name__ == "__main__":
    print(__doc__, "\nA part of the scripts beside it: by itself it does nothing.")
