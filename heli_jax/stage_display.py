"""What a command is at, on standard error: a line that changes on a terminal, else one now and
then."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from heli_jax import stages
from heli_jax.numbers import terminal_sentence
from heli_jax.stages import Stage
from heli_jax.terminal_table import plain_text

_AFTER = 2.0
"""s: what is done sooner shows nothing"""
_EVERY = 30.0
"""s between two lines where standard error is no terminal"""
_COUNTED = 100_000
"""steps beyond which a share is shown: bytes of a file"""
_SHORTEST = 12
"""letters of a stage's name that stay, however narrow the terminal"""
_COMPILES = "/jax/compilation_cache/compile_requests_use_cache"
_COMPILED = "/jax/core/compile/backend_compile_duration"


@contextlib.contextmanager
def on_terminal(say: Callable[[str], None]) -> Iterator[None]:
    """Show the stages that last.

    Args:
        say: prints a line, where standard error is no terminal.
    """
    display = _Display(say)
    try:
        with stages.observed_by(display):
            yield
    finally:
        display.close()


class _Display:
    """An `Observer` with a thread of its own that begins with the first stage."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say = say
        self.stack: list[Stage] = []
        self.compiling: float | None = None
        # Any: of rich, which is imported only when there is something to show.
        self.live: Any = None
        self.lock = threading.Lock()
        self.over = threading.Event()
        self.thread: threading.Thread | None = None
        self.listens = False

    def begin(self, stage: Stage) -> None:
        self.stack.append(stage)
        # Not imported for it: commands that read a log alone do without JAX.
        if not self.listens and "jax" in sys.modules:
            self._listen()
        if self.thread is None:
            self.thread = threading.Thread(target=self._watch, daemon=True)
            self.thread.start()

    def end(self, stage: Stage) -> None:
        self.stack.remove(stage)
        # The line goes with the last of them: what is printed next may be a result.
        if not self.stack:
            self._hide()

    def close(self) -> None:
        """Show nothing more."""
        self.over.set()
        self._hide()
        if not self.listens:
            return
        from jax import monitoring

        monitoring.unregister_event_listener(self._compiles)
        monitoring.unregister_event_duration_listener(self._compiled)

    def text(self) -> str:
        """What is done now, in one line."""
        try:
            stage = self.stack[-1]
        except IndexError:
            return ""
        return plain_text(terminal_sentence(in_words(stage, self.compiling, time.perf_counter())))

    def _listen(self) -> None:
        from jax import monitoring

        self.listens = True
        monitoring.register_event_listener(self._compiles)
        monitoring.register_event_duration_secs_listener(self._compiled)

    # Any: whatever else JAX says of an event.
    def _compiles(self, event: str, **_: Any) -> None:
        if event == _COMPILES:
            self.compiling = time.perf_counter()

    def _compiled(self, event: str, duration_secs: float, **_: Any) -> None:
        if event == _COMPILED:
            self.compiling = None

    def _watch(self) -> None:
        terminal, last = sys.stderr.isatty(), time.perf_counter()
        while not self.over.wait(0.5):
            now = time.perf_counter()
            lasts = self._lasts(now)
            if terminal and lasts:
                self._show()
            elif lasts and now - last > _EVERY:
                last = now
                self.say(self.text())
            elif not lasts:
                last = now

    def _lasts(self, now: float) -> bool:
        stack = self.stack[:]
        return bool(stack) and now - stack[0].began > _AFTER

    def _show(self) -> None:
        with self.lock:
            if self.live is not None or not self.stack or self.over.is_set():
                return
            from rich.console import Console
            from rich.errors import LiveError
            from rich.live import Live
            from rich.text import Text

            console = Console(stderr=True)

            def line() -> Any:
                return Text(fitted(self.text(), console.width), no_wrap=True, overflow="ellipsis")

            # What else is printed meanwhile comes above the line.
            live = Live(
                console=console,
                get_renderable=line,
                transient=True,
                refresh_per_second=2,
            )
            with contextlib.suppress(LiveError):  # the bar of a sweep is shown
                live.start()
                self.live = live

    def _hide(self) -> None:
        with self.lock:
            if self.live is not None:
                self.live.stop()
            self.live = None


def fitted(text: str, width: int) -> str:
    """A line of `in_words` for a terminal: what is too long loses of its name, never a digit.

    Args:
        text: `fitting a, b and c: step 12, cost 1.2e+03, 14 s`.
        width: of the terminal, in columns.
    """
    # The last column stays free, or some terminals begin a new line.
    over = len(text) - (width - 1)
    name, colon, rest = text.rpartition(": ")
    if over <= 0 or not colon:
        return text
    kept = len(name) - over - 1
    if kept >= _SHORTEST:
        return f"{name[:kept]}…: {rest}"
    name = f"{name[: _SHORTEST - 1]}…" if len(name) > _SHORTEST else name
    parts = rest.split(", ")
    while len(parts) > 1 and len(f"{name}: {', '.join(parts)}") >= width:
        # How long it has gone on, the last of them, is said longest; the cost before the step.
        parts.pop(1 if len(parts) > 2 else 0)
    return f"{name}: {', '.join(parts)}"


def in_words(stage: Stage, compiling: float | None, now: float) -> str:
    """A stage as it stands: `fitting Ixx: step 12, cost 1.2e+03, 0.8 steps/s, 14 s`.

    Args:
        stage: what is done.
        compiling: since when XLA compiles; None where it does not.
        now: [s], of the same clock, `time.perf_counter`.
    """
    spent = now - stage.began
    if compiling is not None and now - compiling > _AFTER:
        return f"{stage.words}: compiling, {now - compiling:.0f} s"
    detail = [stage.detail] if stage.detail else []
    if stage.part is not None:
        detail = [f"start {stage.part[0]} of {stage.part[1]}", *detail]
    if stage.first is None:
        return f"{stage.words}: {', '.join([*detail, _time(spent)])}"
    share = stage.total is not None and stage.total > _COUNTED
    of = f"{stage.done} of {stage.total}" if stage.total else f"step {stage.done}"
    parts = [f"{100 * stage.done / stage.total:.0f} %" if stage.total and share else of, *detail]
    done, since = stage.done - stage.first[0], now - stage.first[1]
    # The first step compiles: a rate that contained it would foretell hours.
    if done and since > 0 and not share:
        parts.append(f"{done / since:.2g} a second")
    parts.append(_time(spent))
    if done and stage.total and stage.done < stage.total:
        parts.append(f"{_time((stage.total - stage.done) * since / done)} left")
    elif stage.part is not None and stage.part[0] > 1:
        over, of_all = stage.part[0] - 1, stage.part[1]
        parts.append(f"about {_time(spent * (of_all - over) / over)} left")
    elif done and stage.part is None and stage.limit is not None and stage.done < stage.limit:
        # A search has no length: it ends where it arrives, and is given up after so many steps.
        parts.append(f"search ends within {_time((stage.limit - stage.done) * since / done)}")
    return f"{stage.words}: {', '.join(parts)}"


def _time(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds // 3600:.0f}:{seconds // 60 % 60:02.0f}:{seconds % 60:02.0f}"
