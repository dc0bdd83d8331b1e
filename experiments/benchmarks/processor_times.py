"""Processor time of each command, compared with another revision.

Times are user and system seconds of the whole process on the demo's configurations. They are the
least of several runs, after one that fills the caches of bytecode and of JAX's programs. The two
revisions take turns. The other one is checked out into a temporary worktree and run by the same
Python through PYTHONPATH. Other load adds to both.

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
"""Longest time of a command [s], the first time with compilation."""


class Command(NamedTuple):
    """A command and its limit."""

    name: str
    arguments: tuple[str, ...]
    """Arguments; OUT stands for a new path."""
    bound: float
    """Limit of the processor time on an idle computer [s]."""


COMMANDS = (
    Command("simulate", ("simulate", "configs/bench-roll.yaml", "--out", "OUT.csv"), 2.5),
    Command("info", ("info", "runs/demo/bench.csv"), 0.7),
    Command("check", ("check", "configs/bench-roll.yaml"), 2.0),
    Command("fit", ("fit", "configs/bench-roll.yaml", "--out", "OUT"), 3.5),
    Command("sweep", ("sweep", "configs/bench-sweep.yaml", "--no-figures", "--out", "OUT"), 3.5),
)


class Tree(NamedTuple):
    """A revision of the project, and a folder for its files."""

    folder: Path
    """Folder with heli_jax and configs."""
    work: Path
    """Folder with caches of its own."""

    def seconds(self, command: Command) -> float:
        """Return the user and system time of one run [s].

        Raises:
            SystemExit: the command failed; the message has its output.
        """
        out = self.work / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        words = [a.replace("OUT", str(out / "made")) for a in command.arguments]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
        environment |= {
            "PYTHONPATH": str(self.folder),
            "PYTHONPYCACHEPREFIX": str(self.work / "bytecode"),
            # XLA's programs are identified by content, so one folder serves all.
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
    """Return a revision with a copy of the configurations, and the log that they read."""
    work.mkdir()
    # Both use the present configurations, since only the programs are compared.
    shutil.copytree(ROOT / "configs", work / "configs")
    made = Tree(folder, work)
    log = ("simulate", "configs/bench-roll.yaml", "--out", str(work / "runs/demo/bench.csv"))
    (work / "runs/demo").mkdir(parents=True)
    made.seconds(Command("simulate", log, 0.0))
    return made


def measured(trees: list[Tree], runs: int) -> list[tuple[Command, list[float]]]:
    """Return the least time of each tree by command; the trees take turns."""
    rows = []
    for command in COMMANDS:
        for one in trees:
            one.seconds(command)  # fills the caches
        # The first tree changes with each run.
        times: list[list[float]] = [[] for _ in trees]
        for k in range(runs):
            for i in (range(len(trees)), reversed(range(len(trees))))[k % 2]:
                times[i].append(trees[i].seconds(command))
        rows.append((command, [min(t) for t in times]))
        print(f"{command.name} done", file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Measure and print the table."""
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
