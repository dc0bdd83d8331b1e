"""What is being done, how far it is and how long it took, for whoever wants to show or keep it.

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
    """What a reader assumed or doubts, among the words of progress: who hides these shows it."""

    __slots__ = ()


@dataclass
class Stage:
    """A part of the work that is under way."""

    words: str
    total: int | None = None
    """how many steps it has; None where that is not known beforehand"""
    done: int = 0
    """how many of them are done"""
    detail: str = ""
    """what the last one said: a cost"""
    began: float = field(default_factory=time.perf_counter)
    first: tuple[int, float] | None = None
    """what was done, and when, as the first of them was: it may have been compiled before"""
    limit: int | None = None
    """how many steps may be done when the search under way ends at the latest"""
    part: tuple[int, int] | None = None
    """which of how many equal parts is under way, from 1: starts of an optimiser"""


class Observer(Protocol):
    """Hears of stages as they begin and end; what is done within them it reads off them."""

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
    """Tell an observer of the stages meanwhile.

    Args:
        observer: who hears of them.
    """
    token = _work.set(_Work(observer))
    try:
        yield
    finally:
        _work.reset(token)


@contextlib.contextmanager
def recorded() -> Iterator[dict[str, float]]:
    """Keep how long the outermost stages take meanwhile.

    Yields:
        Seconds by the words of a stage, and under 'compilation (of these)' what of them XLA took
        to compile.
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
        words: what is done.
        total: how many steps it has, where that is known.
        name: under which its time is kept; `words` unless given.
        shown: whether an observer hears of it.
    """
    work = _work.get()
    if work is None:
        yield
        return
    one = Stage(words, total)
    work.stack.append(one)
    observer = work.observer if shown else None
    if observer is not None:
        observer.begin(one)
    try:
        yield
    finally:
        work.stack.remove(one)
        if observer is not None:
            observer.end(one)
        if work.seconds is not None and not work.stack:
            kept = name or words
            spent = time.perf_counter() - one.began
            work.seconds[kept] = work.seconds.get(kept, 0.0) + spent


def watched() -> bool:
    """Whether anybody looks: what it costs to say how far a stage is can be saved otherwise."""
    work = _work.get()
    return work is not None and work.observer is not None


def note(detail: str) -> None:
    """What the innermost stage is at, between two of its steps.

    Args:
        detail: in words.
    """
    work = _work.get()
    if work is not None and work.stack:
        work.stack[-1].detail = detail


def at_most(steps: int) -> None:
    """The innermost stage begins a search that ends after so many further steps at the latest.

    Args:
        steps: how many.
    """
    work = _work.get()
    if work is not None and work.stack:
        inner = work.stack[-1]
        inner.limit = inner.done + steps


def part(which: tuple[int, int] | None) -> None:
    """The innermost stage begins one of several parts that take about as long as each other.

    Args:
        which: its number from 1, and how many there are; None after the last of them.
    """
    work = _work.get()
    if work is not None and work.stack:
        work.stack[-1].part = which


def advance(steps: int = 1, detail: str = "") -> None:
    """The innermost stage has done more.

    Args:
        steps: how many.
        detail: what the last one said.
    """
    work = _work.get()
    if work is not None and work.stack:
        reach(work.stack[-1].done + steps, detail)


def reach(done: int, detail: str = "") -> None:
    """The innermost stage has done so many steps in all.

    Args:
        done: how many.
        detail: what the last one said.
    """
    work = _work.get()
    if work is not None and work.stack:
        inner = work.stack[-1]
        inner.done, inner.detail = done, detail
        if inner.first is None:
            inner.first = inner.done, time.perf_counter()
