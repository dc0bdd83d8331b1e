"""The page: in one file, escaped, verdict first, and no number that the data do not bear."""

import dataclasses
import html
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from heli_jax import numbers
from heli_jax.finding import note
from heli_jax.identification.validation.metrics import Whiteness
from heli_jax.report import files, tables
from heli_jax.report.drawings import Analysis
from heli_jax.report.files import SensorAgreement, SupplementaryAnalyses
from heli_jax.report.html import write_report
from heli_jax.report.origin import origin
from heli_jax.vehicle import Constant
from tests.report.conftest import SCRIPT

FILES = ("config.yaml", "fit.json", "signals.csv", "figures/")
CONSTANTS = {"Ixx": Constant(0.024, "kg m^2", "measured & <u>swung</u>")}


class Links(HTMLParser):
    """Everything a browser would load, and every tag."""

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
    loaded = [v for v in links.addresses if not v.startswith("#") and v not in FILES]
    assert loaded
    assert all(v.startswith(("data:image/svg+xml;base64,", "data:image/png;")) for v in loaded)
    assert links.tags.count("img") == len(names) == 6
    anchors = {v[1:] for v in links.addresses if v.startswith("#")}
    assert anchors <= set(re.findall(r'id="([^"]+)"', text))
    for name in names:
        assert (folder / "figures" / f"{name}.svg").stat().st_size > 1000
    assert len(text) < 500_000


def test_text_from_logs_and_configurations_is_escaped(sound_page):
    text, names, _ = sound_page
    tags = Links(text).tags
    assert not {"b", "i", "u"} & set(tags)
    # The page's own: its numbers, the library, what draws with it, what copies tables.
    assert tags.count("script") == 4
    assert "<script>alert" not in text
    # Text that would end a script, in the numbers of one.
    [content] = re.findall(r'<script type="application/json" id="numbers">(.*?)</script>', text)
    assert SCRIPT in json.loads(content)["charts"][0]["title"]
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert "&lt;b&gt;bench&lt;/b&gt;" in text
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", n) for n in names)


def test_verdict_comes_first(sound_page):
    text = words(sound_page[0])
    verdict = text.index("converged: the data determine Ixx and If")
    assert verdict < text.index("Estimates")
    assert text.count("Estimates") >= 1


def test_what_the_headline_says_is_not_repeated_and_remedies_are_said(sound, sound_page, tmp_path):
    assert words(sound_page[0]).count("the data determine Ixx and If") == 1
    assert "The data determine Ixx and If" not in words(sound_page[0])
    fit = sound[0]
    verdict = dataclasses.replace(
        fit.verdict,
        identifiable=False,
        undetermined=("If",),
        sentences=(
            "The data do not determine If: fix If or give it a prior.",
            "The data determine Ixx.",
        ),
    )
    text = words(page(sound, tmp_path, status="not-identifiable", verdict=verdict)[0])
    assert "fix If or give it a prior." in text
    assert "The data determine Ixx." in text


def test_the_caption_of_the_responses_names_least_squares_where_they_are_drawn(sound, tmp_path):
    fit, problem, baseline = sound
    for drawn in (baseline, None):
        text, _ = page((fit, problem, drawn), tmp_path / str(drawn is None))
        [caption] = re.findall(r"<figcaption>([^<]*Magnitude and phase.*?)</figcaption>", text)
        assert ("recursive least squares" in caption) == (drawn is not None)


def test_captions_are_words(sound_page):
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", sound_page[0])
    assert len(captions) == len(sound_page[1])
    for name in sound_page[1]:
        [caption] = [c for c in captions if f"(figures/{name}.svg)" in c]
        assert len(caption.split()) > 8


def test_paper_s_factor_is_told(sound_page):
    assert "cyclic_moment" in words(sound_page[0])


def test_undetermined_parameters_have_no_numbers(not_identifiable, not_identifiable_page):
    fit = not_identifiable[0]
    assert "✗ converged, not identifiable: the data do not determine Ixx, If and a" in words(
        not_identifiable_page
    )
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


def test_coloured_residuals_are_announced_before_the_numbers(sound, tmp_path):
    name = next(iter(sound[0].whiteness))
    coloured = {name: Whiteness(False, 1e-9, 100, 0.4, 0.9)}
    text = words(page(sound, tmp_path, whiteness=coloured)[0])
    assert "converged: the data determine Ixx and If, but the intervals are too narrow" in text
    assert text.index("The residuals are not white") < text.index("95 % (too narrow)")


def test_a_fit_without_baseline_and_not_converged(sound, tmp_path):
    fit, problem, _ = sound
    fit = dataclasses.replace(fit, status="not-converged", starts=fit.starts[:1])
    names = write_report(tmp_path, Analysis(fit, problem), "bench", {})
    assert "rls" not in names
    assert "starts" not in names
    text = words((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "✗ not converged:" in text
    assert "One start" in text
    # Of numbers that are no result there are no intervals to speak of.
    coloured = dict.fromkeys(fit.whiteness, Whiteness(False, 1e-9, 100, 0.4, 0.9))
    small = dict(fit.estimates, If=fit.estimates["If"]._replace(value=-1.234e-4))
    text = words(page(sound, tmp_path, status=fit.status, whiteness=coloured, estimates=small)[0])
    assert "The residuals are not white." in text
    assert "too narrow" not in text
    assert "−1.23·10⁻⁴ (no result)" in text


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (0.024, 2.1e-5, "0.024000 ± 0.000021"),
        (0.024, 0.0019, "0.0240 ± 0.0019"),
        (1.7e-4, 1.234e-7, "1.7000·10⁻⁴ ± 0.0012·10⁻⁴"),
        (-0.0461, 0.0058, "−0.0461 ± 0.0058"),
        (0.0001, 0.5, "0.00 ± 0.50"),
        (28480.0, 284.0, "28480 ± 280"),
        (212.61, 0.36, "212.61 ± 0.36"),
    ],
)
def test_digits_follow_the_standard_deviation(value, sd, text):
    assert numbers.with_sd(value, sd) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (np.inf, "∞"),
        (0.0, "0"),
        (-2.5e-12, "−2.5·10⁻¹²"),
        (12345.6, "12346"),
    ],
)
def test_numbers(value, text):
    assert numbers.number(value, 4) == text


def test_what_sensors_say_of_each_other_comes_before_the_fit(sound, tmp_path):
    """The fit behind it converges and is adequate in size, whatever its sensors say."""
    found = SensorAgreement(
        False,
        "Not compatible: no errors bring psi to 3.2e-07.",
        (note("a.note", "lambda_p +23 %: much"),),
        ("error", "estimate, 95 %", "unit", "shows", "what it is"),
        (("lambda_p", "0.226 ± 0.061", "1", "yes", "scale"),),
    )
    fit, problem, baseline = sound
    analysis = Analysis(fit, problem, baseline, SupplementaryAnalyses(sensors=found))
    write_report(tmp_path, analysis, "bench", CONSTANTS)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<title>bench: not compatible</title>" in text
    shown = words(text)
    places = [
        shown.index(what)
        for what in ("✗ Not compatible: no errors bring psi to 3.2·10⁻⁷.", "0.226 ± 0.061")
    ]
    assert places == sorted(places)
    assert places[-1] < shown.index("converged:")
    content = files.fit_json(fit, problem, baseline, analysis.supplementary)
    assert content["compatibility"]["compatible"] is False
    assert content["compatibility"]["shows"] == {"lambda_p": "yes"}
