"""Stages of the work in progress, with their progress and times.

By default nothing is kept or shown. `recorded` keeps the times of a run, and `observed_by` notifies
an observer such as the command line.
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
    """A doubt or a reader's assumption among progress messages, which --quiet also shows."""

    __slots__ = ()


@dataclass
class Stage:
    """A part of the work in progress."""

    words: str
    total: int | None = None
    """Number of steps; None if unknown."""
    done: int = 0
    """Number of completed steps."""
    detail: str = ""
    """Detail of the last step, such as a cost."""
    began: float = field(default_factory=time.perf_counter)
    first: tuple[int, float] | None = None
    """Completed steps and time at the first report. Compilation may precede it."""


class Observer(Protocol):
    """Receives the beginnings and ends of stages, and reads their progress from them."""

    def begin(self, stage: Stage) -> None:
        """Handle the beginning of a stage, possibly within another."""
        ...

    def end(self, stage: Stage) -> None:
        """Handle the end of a stage, successful or not."""
        ...


@dataclass
class _Work:
    observer: Observer | None = None
    seconds: dict[str, float] | None = None
    stack: list[Stage] = field(default_factory=list)


# A context variable keeps fits in threads apart. A new thread has none and reports nothing.
_work: ContextVar[_Work | None] = ContextVar("heli_jax_work", default=None)


@contextlib.contextmanager
def observed_by(observer: Observer) -> Iterator[None]:
    """Notify an observer of stages within the context."""
    token = _work.set(_Work(observer))
    try:
        yield
    finally:
        _work.reset(token)


@contextlib.contextmanager
def recorded() -> Iterator[dict[str, float]]:
    """Record the times of the outermost stages within the context.

    Yields:
        Times by the words of a stage [s]; 'compilation (of these)' is XLA's share for compiling.
    """
    # Local import, since the command line's parser must not wait for JAX.
    from jax import monitoring

    outer = _work.get()
    seconds = {COMPILATION: 0.0}

    # Any: other data of JAX's event.
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
    """Mark the body of the context as a stage of the work.

    Args:
        name: key for its time; default: `words`.
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


def is_watched() -> bool:
    """True if there is an observer; otherwise progress need not be computed."""
    work = _work.get()
    return work is not None and work.observer is not None


def _innermost() -> Stage | None:
    work = _work.get()
    return work.stack[-1] if work is not None and work.stack else None


def note(detail: str) -> None:
    """Set the detail of the innermost stage between two of its steps."""
    if (inner := _innermost()) is not None:
        inner.detail = detail


def advance(steps: int = 1, detail: str = "") -> None:
    """Count further steps of the innermost stage as done; `detail` describes the last one."""
    if (inner := _innermost()) is not None:
        reach(inner.done + steps, detail)


def reach(done: int, detail: str = "") -> None:
    """Set the total of completed steps of the innermost stage; `detail` describes the last one."""
    if (inner := _innermost()) is not None:
        inner.done, inner.detail = done, detail
        inner.first = inner.first or (done, time.perf_counter())
