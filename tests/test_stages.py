"""Progress messages of long work, and its stored times."""

import re
import threading
import time

import pytest

from heli_jax import stages
from heli_jax.cli import terminal
from heli_jax.stages import Stage


class Heard:
    def __init__(self):
        self.said = []

    def begin(self, stage):
        self.said.append(f"+{stage.words}")

    def end(self, stage):
        self.said.append(f"-{stage.words} {stage.done}")


def test_outermost_stages_make_up_the_time():
    began = time.perf_counter()
    with stages.recorded() as seconds:
        for _ in range(2):
            with stages.stage("a fit", name="fit"), stages.stage("within"):
                time.sleep(0.02)
        with pytest.raises(KeyError), stages.stage("report"):
            raise KeyError
    spent = time.perf_counter() - began
    assert seconds.keys() == {stages.COMPILATION, "fit", "report"}
    assert 0.04 <= sum(seconds.values()) <= spent


def test_an_observer_hears_of_stages_of_its_own_thread_alone():
    heard = Heard()
    with stages.observed_by(heard):
        assert stages.is_watched()
        with stages.stage("outer", total=3), stages.recorded(), stages.stage("inner"):
            stages.advance(2, "cost 1")
        with stages.stage("reading", shown=False):
            pass
        other = threading.Thread(target=lambda: heard.said.append(stages.is_watched()))
        other.start()
        other.join()
    assert heard.said == ["+outer", "+inner", "-inner 2", "-outer 0", False]
    assert not stages.is_watched()
    with stages.stage("nobody listens"):
        stages.advance()


@pytest.mark.parametrize(
    ("stage", "numbers"),
    [
        (Stage("fit", began=0.0), ["14"]),
        (Stage("fit", None, 11, "cost 2", 0.0, (1, 4.0)), ["11", "2", "14"]),
        # Twenty in the ten seconds after the first eight, which were compiled before.
        (
            Stage("bootstrap", 1000, 28, "", 0.0, (8, 4.0)),
            ["28", "1000", "14", "0", "08", "06"],
        ),
        (Stage("reading", 10**8, 5 * 10**7, "", 0.0, (10**7, 6.0)), ["50", "14", "10"]),
    ],
)
def test_a_stage_in_words(stage, numbers):
    assert re.findall(r"\d+", terminal.in_words(stage, 14.0)) == numbers


def test_what_lasts_is_said_now_and_then_where_there_is_no_terminal(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "_AFTER", 0.0)
    monkeypatch.setattr(terminal, "_EVERY", 0.01)
    said = ""
    with terminal.progress_shown(False), stages.stage("a long fit"):
        waited = time.perf_counter()
        while not said and time.perf_counter() - waited < 10.0:
            said = capsys.readouterr().err
    assert said.startswith("heli-jax: a long fit: ")
