"""What each command takes of the processor, beside another revision.

Seconds of user and system time of the whole process, on the demo's configurations: the least of
several runs, after one that fills the caches, those of Python's bytecode and of JAX's programs
included; the two revisions take turns. The other one is checked out into a temporary worktree and
run by the same Python, found by PYTHONPATH. Load on the machine adds to both.

    python experiments/benchmarks/processor_times.py [REVISION]
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

from script import Size, asked

ROOT = Path(__file__).parents[2]
_LONGEST = 600.0
"""a command may take [s], the first time when all is compiled"""


class Command(NamedTuple):
    """One command and what is asked of it."""

    name: str
    arguments: tuple[str, ...]
    """OUT stands for a new place"""
    bound: float
    """processor seconds on an idle machine"""


COMMANDS = (
    Command("simulate", ("simulate", "configs/bench-roll.yaml", "--out", "OUT.csv"), 2.5),
    Command("info", ("info", "runs/demo/bench.csv"), 0.7),
    Command("check", ("check", "configs/bench-roll.yaml"), 2.0),
    Command("fit", ("fit", "configs/bench-roll.yaml", "--out", "OUT"), 3.5),
    Command("sweep", ("sweep", "configs/bench-sweep.yaml", "--no-figures", "--out", "OUT"), 3.5),
)


class Tree(NamedTuple):
    """A revision of the project, and where what it makes is kept."""

    folder: Path
    """with heli_jax and configs"""
    work: Path
    """with caches of its own"""

    def seconds(self, command: Command) -> float:
        """User and system time of one run.

        Raises:
            SystemExit: the command failed; with what it said.
        """
        out = self.work / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        words = [a.replace("OUT", str(out / "made")) for a in command.arguments]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
        environment |= {
            "PYTHONPATH": str(self.folder),
            "PYTHONPYCACHEPREFIX": str(self.work / "bytecode"),
            # What XLA compiles is known by its content: one folder may serve all.
            "JAX_COMPILATION_CACHE_DIR": os.environ.get(
                "JAX_COMPILATION_CACHE_DIR", str(self.work / "compiled")
            ),
            "XDG_CACHE_HOME": str(self.work),
        }
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run = subprocess.run(
            [sys.executable, "-P", "-m", "heli_jax", *words],
            cwd=self.work,
            env=environment,
            capture_output=True,
            text=True,
            timeout=_LONGEST,
            check=False,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        if run.returncode:
            raise SystemExit(f"{self.folder}: {command.name}: {run.stderr}")
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def tree(folder: Path, work: Path) -> Tree:
    """A revision with a copy of the configurations beside the log that they read."""
    work.mkdir()
    # The present configurations for both: what is compared is the program.
    shutil.copytree(ROOT / "configs", work / "configs")
    made = Tree(folder, work)
    log = ("simulate", "configs/bench-roll.yaml", "--out", str(work / "runs/demo/bench.csv"))
    (work / "runs/demo").mkdir(parents=True)
    made.seconds(Command("simulate", log, 0.0))
    return made


def measured(trees: list[Tree], runs: int) -> list[tuple[Command, list[float]]]:
    """By command the least of the runs of each tree, which take turns."""
    rows = []
    for command in COMMANDS:
        for one in trees:
            one.seconds(command)  # fills the caches
        # Whose turn it is to be first changes with each run.
        times: list[list[float]] = [[] for _ in trees]
        for k in range(runs):
            for i in (range(len(trees)), reversed(range(len(trees))))[k % 2]:
                times[i].append(trees[i].seconds(command))
        rows.append((command, [min(t) for t in times]))
        print(f"{command.name} done", file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Measure and print one table."""
    options = asked(
        __doc__,
        "five minutes",
        Size("revision", "HEAD~1", "HEAD~1", "of git, to compare with"),
        Size("runs", 5, 1, "of each command"),
    )
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "tree"
        git = ("git", "-C", str(ROOT), "worktree")
        add = (*git, "add", "--quiet", "--detach", str(other), options.revision)
        if subprocess.run(add, check=False).returncode:
            raise SystemExit(f"{options.revision}: expected a revision of {ROOT}")
        try:
            both = [tree(other, Path(folder) / "other"), tree(ROOT, Path(folder) / "present")]
            rows = measured(both, options.runs)
        finally:
            subprocess.run((*git, "remove", "--force", str(other)), check=True)
    print(f"| processor seconds | {options.revision} | now | ratio | wanted |")
    print("|---|---|---|---|---|")
    for command, (then, now) in rows:
        print(
            f"| `{command.name}` | {then:.2f} | {now:.2f} | {now / then:.2f} | {command.bound:g} |"
        )


if __name__ == "__main__":
    main()
