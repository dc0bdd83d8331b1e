"""The page: one file, escaped, verdict first, and no numbers that the data do not determine."""

import dataclasses
import html
import json
import re
from html.parser import HTMLParser

import pytest

from heli_jax import numbers
from heli_jax.finding import note
from heli_jax.report import files, fit_page, tables
from heli_jax.report.files import SensorAgreement, SupplementaryAnalyses
from heli_jax.report.fit_page import Analysis, write_report
from heli_jax.report.origin import origin
from heli_jax.vehicle import Constant
from tests.report.conftest import SCRIPT

FILES = ("config.yaml", "fit.json", "signals.csv", "figures/")
CONSTANTS = {"Ixx": Constant(0.024, "kg m^2", "measured & <u>swung</u>")}


class Links(HTMLParser):
    """Collect everything that a browser would load, and every tag."""

    def __init__(self, text):
        super().__init__()
        self.addresses, self.tags = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "srcset", "data", "action")]


def page(analysed, folder, **changes):
    fit, problem, baseline = analysed
    fit = dataclasses.replace(fit, **changes)
    analysis = Analysis(fit, problem, baseline)
    made = origin(f"# </pre>{SCRIPT}\u2028", FILES[:3])
    names = write_report(folder, analysis, f"bench {SCRIPT}", CONSTANTS, made)
    return (folder / "report.html").read_text(encoding="utf-8"), names


def words(text):
    text = re.sub(r"<(style|script)\b.*?</\1>|<!--.*?-->", "", text, flags=re.S)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", text)))


@pytest.fixture(scope="module")
def sound_page(sound, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    return *page(sound, folder), folder


@pytest.fixture(scope="module")
def not_identifiable_page(not_identifiable, tmp_path_factory):
    return page(not_identifiable, tmp_path_factory.mktemp("not_identifiable"))[0]


def test_page_holds_everything_itself(sound_page):
    text, names, folder = sound_page
    links = Links(text)
    assert "@import" not in text
    assert "url(" not in text
    files = {f"figures/{name}.svg" for name in names}
    loaded = [v for v in links.addresses if not v.startswith("#") and v not in {*FILES, *files}]
    assert loaded == []
    # The page draws every figure, also the worst output of the first screen.
    assert len(names) == 3
    assert text.count("<figure data-chart=") == 4
    assert links.tags.count("img") == 0
    anchors = {v[1:] for v in links.addresses if v.startswith("#")}
    assert anchors <= set(re.findall(r'id="([^"]+)"', text))
    for name in names:
        assert (folder / "figures" / f"{name}.svg").stat().st_size > 1000
        assert text.count(f"(figures/{name}.svg)<") == 1
    assert len(text) < 300_000


def test_the_first_screen_has_verdict_estimates_worst_output_and_three_findings(sound, tmp_path):
    # Of findings on one topic only the first is shown.
    doubts = tuple(note(f"a.{max(k - 1, 0)}", f"finding {k}") for k in range(5))
    text, _ = page(sound, tmp_path, findings=doubts)
    first = text[
        text.index('<div class="first">') : text.index('<nav class="quiet" aria-label="Parts')
    ]
    assert first.count('<p class="line ') == 3
    order = [first.index(part) for part in ("Converged.", "Identifiable.", "Adequate.")]
    assert order == sorted(order)
    bars = re.findall(r'<rect x="([\d.]+)" y="3" width="([\d.]+)"', first)
    assert len(bars) == len(sound[0].estimates)
    for (x, width), e in zip(bars, sound[0].estimates.values(), strict=True):
        # An interval contains its estimate, which is at the middle of the axis.
        assert 0.0 <= float(x) < 50.0 < float(x) + float(width) <= 100.0
        shares = e.upper95 / e.value - 1.0, 1.0 - e.lower95 / e.value
        assert (float(x) + float(width) - 50.0) / (50.0 - float(x)) == pytest.approx(
            shares[0] / shares[1], rel=0.05
        )
    assert first.count("<figure data-chart=") == 1
    assert [f"finding {k}" in first.lower() for k in range(5)] == [
        True, False, True, True, False
    ]  # fmt: skip
    assert ": adequate</title>" in text
    assert "Is this log enough?" in text[text.index("</nav>", text.index(first[-50:])) :]


def test_text_from_logs_and_configurations_is_escaped(sound_page):
    text, names, _ = sound_page
    tags = Links(text).tags
    assert not {"b", "i", "u"} & set(tags)
    # The page's scripts: its numbers, the library, its drawing code, and the copying of tables.
    assert tags.count("script") == 4
    assert "<script>alert" not in text
    # Text in the numbers that would end a script.
    [content] = re.findall(r'<script type="application/json" id="numbers">(.*?)</script>', text)
    assert SCRIPT in json.loads(content)["charts"][0]["title"]
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert "&lt;b&gt;bench&lt;/b&gt;" in text
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", n) for n in names)


def test_undetermined_parameters_have_no_numbers(not_identifiable, not_identifiable_page):
    fit = not_identifiable[0]
    assert "✗ Not identifiable." in words(not_identifiable_page)
    assert ": not identifiable</title>" in not_identifiable_page
    assert fit.verdict.text in words(not_identifiable_page)
    for row in tables.parameters(fit).rows:
        assert row[1] == "not determined"
        assert row[2:5] == ("–",) * 3
    for name, e in fit.estimates.items():
        for text in (numbers.number(e.value, k) for k in (4, 5, 6)):
            assert text not in words(not_identifiable_page), name
    assert "a/Ixx" in words(not_identifiable_page)


def test_combinations_stand_beside_the_baseline(not_identifiable, sound):
    for fit, _, baseline in (not_identifiable, sound):
        rows = {row[0]: row for row in tables.baseline_ratios(fit, baseline).rows}
        assert set(rows) == {"a/Ixx", "a/If"}
        for row in rows.values():
            assert "±" in row[2]
    fit, _, baseline = sound
    mean, sd = rows["a/Ixx"][2].split(" ± ")
    e = fit.estimates["Ixx"]
    assert float(mean) == pytest.approx(5.1 / e.value, rel=1e-2)
    assert float(sd) / float(mean) == pytest.approx(e.sd / e.value, rel=0.1)


def test_a_fit_without_baseline_and_not_converged(sound, tmp_path):
    fit, problem, _ = sound
    small = dict(fit.estimates, If=fit.estimates["If"]._replace(value=-1.234e-4))
    changes = {"status": "not-converged", "starts": fit.starts[:1], "estimates": small}
    fit = dataclasses.replace(fit, **changes)
    names = write_report(tmp_path, Analysis(fit, problem), "bench", {})
    assert "rls" not in names
    assert [line.level for line in fit_page.lines(fit)] == ["bad", "none", "none"]
    # Without results there are no intervals.
    row = next(row for row in tables.parameters(fit).rows if row[0] == "If")
    assert row[1:5] == ("−1.23·10⁻⁴ (no result)", "–", "–", "–")


def test_what_sensors_say_of_each_other_comes_before_the_fit(sound, tmp_path):
    """Test a page of a converged, adequate fit with doubts about its sensors."""
    head, errors = ("error", "estimate, 95 %", "shows"), (("lambda_p", "0.226 ± 0.061", "yes"),)
    found = SensorAgreement(False, "Not so.", (note("a.note", "much"),), head, errors)
    fit, problem, baseline = sound
    analysis = Analysis(fit, problem, baseline, SupplementaryAnalyses(sensors=found))
    write_report(tmp_path, analysis, "bench", CONSTANTS)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<title>bench: not compatible</title>" in text
    assert text.index('id="sensors"') < text.index("0.226 ± 0.061") < text.index('id="verdict"')
    content = files.fit_json(fit, problem, baseline, analysis.supplementary)
    assert content["compatibility"]["compatible"] is False
    assert content["compatibility"]["shows"] == {"lambda_p": "yes"}
