"""The page: complete, well formed, the same every time, and unmoved by hostile or missing values."""

from __future__ import annotations

import dataclasses
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np

from abbe.service.rendering import (
    ArrowField,
    Contribution,
    DemoReport,
    ParameterRow,
    PolarTrace,
    ResidualSeries,
    RunRow,
    SummaryRow,
    TableCurve,
)
from abbe.service.rendering.html import render_report

VOID = {"meta", "br", "hr", "img", "link", "input"}
HOSTILE = "</title><script>alert(1)</script><img src=x onerror=alert(2)>\"'&\x00\x07\ud800"


class Outline(HTMLParser):
    """Checks that every tag is closed in order, and collects what the tests ask for."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.words: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def svgs(page: str) -> list[ET.Element]:
    return [ET.fromstring(text) for text in re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)]


def test_a_full_report_has_every_section_and_the_verdict_first(full_report: DemoReport) -> None:
    page = render_report(full_report)
    outline = Outline(page)
    assert "script" not in outline.tags
    places = [
        page.index(f'id="{name}"')
        for name in ("h-verdict", "h-summary", "volume-before-t", "h-parameters", "h-limits", "h-tables", "h-residuals")
    ]
    assert places == sorted(places)
    assert page.index('id="h-runs"') < page.index('id="h-provenance"')
    assert outline.tags.count("h1") == 1
    assert ("lang", "en") in outline.attributes


def test_every_picture_is_xml_with_its_own_title_and_description(full_report: DemoReport) -> None:
    pictures = svgs(render_report(full_report))
    assert len(pictures) == 2 + 1 + 1 + 1 + 3 + 1 + 1 + 4
    for picture in pictures:
        title, desc = picture.find("title"), picture.find("desc")
        assert title is not None
        assert desc is not None
        assert title.text
        assert desc.text
        assert picture.get("role") == "img"


def test_identifiers_are_unique(full_report: DemoReport) -> None:
    ids = [value for name, value in Outline(render_report(full_report)).attributes if name == "id"]
    assert len(ids) == len(set(ids))


def test_the_page_asks_no_other_host_for_anything(full_report: DemoReport) -> None:
    page = render_report(full_report)
    assert not re.search(r"https?:|//[a-z]|@import|url\(|\bsrc=|\bhref=", page)


def test_equal_reports_give_equal_bytes(full_report: DemoReport) -> None:
    again = dataclasses.replace(full_report, runs=list(full_report.runs))
    assert render_report(full_report) == render_report(again)


def test_a_report_without_data_still_renders(minimal_report: DemoReport) -> None:
    page = render_report(minimal_report)
    Outline(page)
    assert svgs(page) == []
    assert "No measurement was made." in page
    assert "Undecided" in page


def test_the_uncertainty_decides_the_digits(full_report: DemoReport) -> None:
    page = render_report(full_report)
    assert re.search(r"41\.3</span><span class=\"u\"> ± 1\.0<", page)
    assert re.search(r"18\.20</span><span class=\"u\"> ± 0\.62<", page)


def test_parameters_of_the_set_up_are_folded_away(full_report: DemoReport) -> None:
    page = render_report(full_report)
    fold = page[page.index("<details>") : page.index("</details>")]
    assert ">cup B1 x<" in fold
    assert ">EXX slope<" not in fold
    assert page.count('<th scope="row">cup B1 x<') == 1


def test_hostile_words_stay_words(minimal_report: DemoReport) -> None:
    x = [0.0, 1.0]
    report = dataclasses.replace(
        minimal_report,
        title=HOSTILE,
        lang=HOSTILE,
        machine={HOSTILE: HOSTILE},
        created_utc=HOSTILE,
        versions={HOSTILE: HOSTILE},
        verdict=HOSTILE,
        summary=[SummaryRow(HOSTILE, HOSTILE, 1.0, 1.0, source=HOSTILE)],  # type: ignore[arg-type]
        parameters=[ParameterRow(HOSTILE, 1.0, 0.1, HOSTILE, HOSTILE)],
        not_observable=[HOSTILE],
        runs=[RunRow(HOSTILE, HOSTILE, HOSTILE, 1, 1.0, 1.0)],
        residuals=[ResidualSeries(HOSTILE, HOSTILE, x, x)],
        tables=[TableCurve(HOSTILE, HOSTILE, x, x)],
        diagonals_before={HOSTILE: (x, x)},
        polar=[PolarTrace(HOSTILE, x, x)],
        contributions=[Contribution(HOSTILE, 1.0, 0.1)],
        push_log=[HOSTILE],
        warnings=[HOSTILE],
    )
    page = render_report(report)
    outline = Outline(page)
    assert not {"script", "img"} & set(outline.tags)
    assert not [name for name, _ in outline.attributes if name.startswith("on")]
    assert len(svgs(page)) == 6
    page.encode()


def test_missing_numbers_are_named_not_drawn(minimal_report: DemoReport) -> None:
    nan, inf = float("nan"), float("inf")
    grid = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, nan], [2.0, 2.0, 2.0]])
    report = dataclasses.replace(
        minimal_report,
        machine={"stroke": nan},
        summary=[SummaryRow("a", "µm", nan, 0.0, None, nan, inf), SummaryRow("b", "µm", None, None)],
        parameters=[ParameterRow("p", nan, 1.0, "µm"), ParameterRow("q", 1.0, inf, "µm"), ParameterRow("r", None, None, "µm")],
        runs=[RunRow("r1", "t", "identify", 0, nan, nan)],
        residuals=[ResidualSeries("r1", "t in s", [nan, nan], [nan, nan]), ResidualSeries("r2", "t in s", [], []), _gappy()],
        tables=[TableCurve("X", "X", [0.0, 1.0, 2.0], [nan, 1.0, inf])],
        table_lsb_um=nan,
        arrows_before=ArrowField(grid, np.full((3, 3), nan)),
        arrows_after=ArrowField(np.empty((0, 3)), np.empty((0, 3))),
        diagonals_after={"ppp": ([0.0, nan, 2.0], [1.0, 2.0, nan])},
        polar=[PolarTrace("p", [0.0, nan], [nan, 1.0])],
        contributions=[Contribution("c", nan, nan), Contribution("d", None), Contribution("e", 2.0, nan)],
    )
    page = render_report(report)
    Outline(page)
    assert "n/a" in page
    assert not re.search(r"\b(nan|inf)\b", page)
    for picture in svgs(page):
        for element in picture.iter():
            assert not {"nan", "inf", "-inf"} & set(re.split(r"[ ,]", " ".join(element.attrib.values())))


def _gappy() -> ResidualSeries:
    y = np.linspace(-1.0, 1.0, 4000)
    y[::7] = np.nan
    return ResidualSeries("r3", "t in s", np.arange(4000.0), y)
