"""The work that is under way, how far it is and how long it took, for whoever shows or keeps it.

Nothing is kept or shown unless somebody asks: `recorded` keeps the times of a run, `observed_by`
tells an observer, as the command line does.
"""

import contextlib
import time
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Protocol

COMPILATION = "compilation (of these)"
_COMPILED = "/jax/core/compile/backend_compile_duration"


class Note(str):
    """A doubt or an assumption of a reader among the words of progress: --quiet shows it too."""

    __slots__ = ()


@dataclass
class Stage:
    """A part of the work that is under way."""

    words: str
    total: int | None = None
    """steps that it has; None where that is not known beforehand"""
    done: int = 0
    """steps that are done"""
    detail: str = ""
    """of the last step: a cost"""
    began: float = field(default_factory=time.perf_counter)
    first: tuple[int, float] | None = None
    """steps done, and when, as the first was reported, which may have been compiled before"""


class Observer(Protocol):
    """Hears of stages as they begin and end; it reads off them what is done meanwhile."""

    def begin(self, stage: Stage) -> None:
        """A stage begins, maybe within another."""
        ...

    def end(self, stage: Stage) -> None:
        """It has ended, well or not."""
        ...


@dataclass
class _Work:
    observer: Observer | None = None
    seconds: dict[str, float] | None = None
    stack: list[Stage] = field(default_factory=list)


# By context, so that fits in threads do not mix: a new thread has none and reports nothing.
_work: ContextVar[_Work | None] = ContextVar("heli_jax_work", default=None)


@contextlib.contextmanager
def observed_by(observer: Observer) -> Iterator[None]:
    """Tell an observer of the stages meanwhile."""
    token = _work.set(_Work(observer))
    try:
        yield
    finally:
        _work.reset(token)


@contextlib.contextmanager
def recorded() -> Iterator[dict[str, float]]:
    """Keep how long the outermost stages take meanwhile.

    Yields:
        Seconds by the words of a stage, and under 'compilation (of these)' the part of them that
        XLA took to compile.
    """
    # Here, since the command line's parser must not wait for JAX.
    from jax import monitoring

    outer = _work.get()
    seconds = {COMPILATION: 0.0}

    # Any: whatever else JAX says of an event.
    def compiled(event: str, duration_secs: float, **_: Any) -> None:
        if event == _COMPILED:
            seconds[COMPILATION] += duration_secs

    token = _work.set(_Work(outer.observer if outer else None, seconds))
    monitoring.register_event_duration_secs_listener(compiled)
    try:
        yield seconds
    finally:
        monitoring.unregister_event_duration_listener(compiled)
        _work.reset(token)


@contextlib.contextmanager
def stage(
    words: str, *, total: int | None = None, name: str | None = None, shown: bool = True
) -> Iterator[None]:
    """A part of the work goes on meanwhile.

    Args:
        name: under which its time is kept; `words` unless given.
    """
    work = _work.get()
    if work is None:
        yield
        return
    under_way = Stage(words, total)
    work.stack.append(under_way)
    observer = work.observer if shown else None
    if observer is not None:
        observer.begin(under_way)
    try:
        yield
    finally:
        work.stack.remove(under_way)
        if observer is not None:
            observer.end(under_way)
        if work.seconds is not None and not work.stack:
            spent = time.perf_counter() - under_way.began
            work.seconds[name or words] = work.seconds.get(name or words, 0.0) + spent


def watched() -> bool:
    """True if anybody looks: to compute how far a stage is can be saved otherwise."""
    work = _work.get()
    return work is not None and work.observer is not None


def _innermost() -> Stage | None:
    work = _work.get()
    return work.stack[-1] if work is not None and work.stack else None


def note(detail: str) -> None:
    """Say in words where the innermost stage is between two of its steps."""
    if (inner := _innermost()) is not None:
        inner.detail = detail


def advance(steps: int = 1, detail: str = "") -> None:
    """Count further steps of the innermost stage as done; `detail` is of the last one."""
    if (inner := _innermost()) is not None:
        reach(inner.done + steps, detail)


def reach(done: int, detail: str = "") -> None:
    """Count so many steps in all of the innermost stage as done; `detail` is of the last one."""
    if (inner := _innermost()) is not None:
        inner.done, inner.detail = done, detail
        inner.first = inner.first or (done, time.perf_counter())
