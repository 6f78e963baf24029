"""`abbe papers` as people and programs call it."""

import io
import json
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import pytest
from rich.console import Console

from abbe.service.cli import run
from abbe.service.cli.reference import show_papers
from abbe.service.reference.paper_results import results
from abbe.service.reference.text import lines

VOID = {"meta", "link", "br", "img", "hr", "input"}


def test_json_has_every_row_with_its_numbers(capsys):
    assert run(["papers", "--paper", "yang", "--json"]) == 0
    doc = json.loads(capsys.readouterr().out)
    assert doc["format"] == "abbe-papers/1"
    (paper,) = doc["papers"]
    assert paper["paper"] == "yang"
    for row in paper["rows"]:
        assert row["status"] in {"reproduced", "consistent", "differs", "input", "not reproducible"}
        if row["computed"] is None:
            assert row["status"] in {"input", "not reproducible"}
            assert row["why"]
        else:
            assert row["difference"] == pytest.approx(row["computed"] - row["printed"], abs=1e-15)
            off, slack = abs(row["difference"]), 1e-12 * abs(row["printed"])
            assert (row["status"] == "reproduced") == (off <= row["rounding"] + slack)
            assert (row["status"] == "differs") == (off > row["rounding"] + row["allowance"] + slack)
    assert sum(paper["numbers"].values()) == sum(1 for r in paper["rows"] if r["source"] == "paper" and not r["again"])


def test_json_keeps_checks_apart_from_printed_numbers(capsys):
    assert run(["papers", "--json"]) == 0
    papers = {p["paper"]: p for p in json.loads(capsys.readouterr().out)["papers"]}
    assert {name: p["own_checks"]["holds"] for name, p in papers.items()} == {"pahk": 0, "kwon": 3, "yang": 12, "wang": 0}
    for check in papers["yang"]["checks"]:
        assert check["bound"] == 0.02
        assert check["unit"] == "µrad"
        assert check["status"] == ("holds" if abs(check["found"] - check["expected"]) < check["bound"] else "fails")
    padded = [r for p in papers.values() for r in p["rows"] if r["padding_because"] and r["remark"]]
    assert len(padded) == 3
    assert {r["status"] for r in padded} == {"consistent"}
    assert all(abs(r["difference"]) > r["rounding"] + r["allowance"] for r in padded)


def test_piped_tables_are_at_most_120_wide(capsys):
    assert run(["papers"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("Pahk", "Kwon", "Yang", "Wang"))
    assert max(len(line.rstrip()) for line in out.splitlines()) <= 120
    assert "12 own checks (no printed numbers): 12 holds, 0 fails" in out
    assert re.search(r"laser column by helix R 100 mm \(µrad\), worst of 6 .* 0\.02 +holds", out)


@pytest.fixture(scope="module")
def everything():
    return results()


def shown(found, width: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width, highlight=False)
    show_papers(found, console)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [60, 72, 80, 100, 112, 120, 200])
def test_statuses_and_headings_stay_whole_on_a_terminal(everything, width):
    out = shown(everything, width)
    assert max(len(line.rstrip()) for line in out) <= width
    tables = [line.split() for line in out if re.match(r" *(where +)?quantity +(printed|given) +computed ", line)]
    assert len(tables) == 8  # four papers, math.md twice, own checks twice
    whole = [line for line in out if re.search(r"\b(reproduced|consistent|differs|input|not reproducible|holds)( +\d+)? *$", line)]
    lines_of_rows = sum(len(list(lines([r for r in f.numbers if r.source == s]))) for f in everything for s in ("paper", "math.md"))
    assert len([line for line in whole if line.startswith(" ")]) >= lines_of_rows + 3
    for heading in tables:
        assert "status" in heading
        assert not [word for word in heading if word.endswith(("..", "…"))]
    assert "off" not in tables[0] or width >= 100
    assert "within" not in tables[0] or width >= 112


def test_unknown_paper_is_refused():
    assert run(["papers", "--paper", "newton"]) == 2


class Strict(HTMLParser):
    """Every tag is closed, nothing points outside the page."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.outside, self.links = [], [], [], []

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        if "id" in found:
            self.ids.append(found["id"])
        self.outside += [v for k, v in attrs if k in {"src", "data"} or (k == "href" and not v.startswith("#"))]
        self.links += [v[1:] for k, v in attrs if k == "href"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> str:
    """The page of all four papers, written once."""
    folder = tmp_path_factory.mktemp("page")
    assert run(["papers", "--html", str(folder / "papers.html"), "--json"]) == 0
    assert [p.name for p in folder.iterdir()] == ["papers.html"]
    return (folder / "papers.html").read_text()


def test_html_is_one_sound_file(page):
    parsed = Strict()
    parsed.feed(page)
    assert not parsed.open
    assert len(parsed.ids) == len(set(parsed.ids))
    assert not parsed.outside
    assert set(parsed.links) <= set(parsed.ids)
    assert not any("nan" in values for values in re.findall(r'(?:points|x|y|x1|d)="([^"]*)"', page))
    assert "@import" not in page
    assert "url(" not in page
    for svg in re.findall(r"<svg .*?</svg>", page, re.DOTALL):
        ET.fromstring(svg)


def test_same_rows_give_the_same_bytes_and_json_still_goes_to_stdout(tmp_path, capsys):
    texts = []
    for name in ("one.html", "two.html"):
        assert run(["papers", "--paper", "wang", "--html", str(tmp_path / name), "--json"]) == 0
        json.loads(capsys.readouterr().out)
        texts.append((tmp_path / name).read_bytes())
    assert texts[0] == texts[1]


def test_a_report_that_exists_is_replaced_whole(tmp_path, capsys):
    target = tmp_path / "papers.html"
    target.write_text("old")
    assert run(["papers", "--paper", "wang", "--html", str(target)]) == 0
    assert target.read_text().endswith("</html>")
    assert [p.name for p in tmp_path.iterdir()] == ["papers.html"]
    assert f"report: {target}" in capsys.readouterr().out


@pytest.mark.parametrize("bad", ["missing/report.html", "."])
def test_a_place_that_cannot_be_written_is_one_clear_line(tmp_path, capsys, bad):
    target = tmp_path / bad
    assert run(["papers", "--paper", "wang", "--html", str(target)]) == 2
    err = capsys.readouterr().err
    assert str(target) in err
    assert len(err.strip().splitlines()) <= 2
    assert "Traceback" not in err
    assert not list(tmp_path.rglob("*.html"))
    assert not list(tmp_path.rglob(".*"))


def test_captions_say_what_is_missing_and_how_errors_are_magnified(page):
    text = page.replace("&#39;", "'").replace("\u00a0", " ")
    assert "EXAMPLE: the paper's map is not printed" in text
    assert "25.006 mm" in text
    assert text.count("squareness only") >= 2
    assert "It contains only the three printed squareness errors" in text
    assert len(re.findall(r"errors drawn \d+ ×", text)) >= 2
    assert "Z = 97.616 mm" in text
    assert "The square of ± 1 mm is an assumption from the text" in text
    assert text.count("<svg") == 2 + 2 + 6 + 1


def test_pictures_of_one_surface_name_one_range(page):
    for component in ("e_x", "e_y", "e_z"):
        found = [
            svg for svg in re.findall(r"<svg .*?</svg>", page, re.DOTALL) if f">{component} over" in svg or f">{component}, level" in svg
        ]
        assert len(found) == 2
        assert len({re.search(r"from (\S+ to \S+) µm", svg)[1] for svg in found}) == 1


def test_numbers_of_the_page_keep_their_unit(page, everything):
    names = [name.replace("\u00a0", " ") for name in re.findall(r'<tr><th scope="row">[^<]*</th><td>([^<]*)</td>', page)]
    units = [re.search(r" \(([^()]*)\)$", name) for name in names]
    numbers = [[*f.numbers, *f.of("own check")] for f in everything]
    assert len(names) == sum(map(len, numbers))
    for unit, number in zip(units, (n for found in numbers for n in found), strict=True):
        assert not number.unit or unit[1] == number.unit
    text = re.sub(r"<svg .*?</svg>", "", page, flags=re.DOTALL)
    assert not re.findall(r"\d (?:µm|µrad|mm)\b", text)


def test_the_summary_counts_every_status(page, everything):
    heads = re.findall(r"<th scope=\"col\"[^>]*>([^<]*)</th>", page.split("</thead>")[0])
    assert heads == ["Paper", "reproduced", "consistent", "differs", "input", "not reproducible"]
    for found in everything:
        row = re.search(rf'<tr><th scope="row">{re.escape(found.title)}</th>.*?</tr>', page)[0]
        assert [int(n) for n in re.findall(r">(\d+)</td>", row)] == list(found.counts().values())
