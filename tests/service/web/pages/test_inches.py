"""Every screen for a reader of inches: figures are those of the SI values, computed here from the definition of the inch, 25.4 mm.

A number may differ from the SI value by half of its last digit, and by what the interface or the store had rounded before.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest

from abbe.service.domain.machine import Rules
from abbe.service.domain.progress import RunningCheck
from abbe.service.identification.solution_field import stored_field
from abbe.service.rendering.numbers import MM, Unit
from abbe.service.runs.observations import run_data
from abbe.service.verification.compare_runs import ComparedCurve, LoadedRun, RunDifference, curve, figure_rows
from abbe.service.web import frame, language
from abbe.service.web.frame import Frame
from abbe.service.web.page import environment
from abbe.service.web.pages.new import script_texts
from abbe.service.web.pages.rehearsal import CAMPAIGN
from abbe.service.web.pages.runs import pictures, run_document
from abbe.service.web.pages.whatif import forecast
from abbe.service.web.strip import strip_of
from abbe.service.web.units import INCH, METRIC
from tests.pages_world import Served, as_user
from tests.service.web.pages.test_rehearsal import PLANS, TOLD
from tests.service.web.pages.test_result_screens import observed, runs_of
from tests.service.web.pages.test_screens import SVG

UIN, IN = 0.0254, 25.4
"""µm of a µin, mm of an inch."""
PAIR = r"([−\d.]+) ± ([\d.]+)"


@pytest.fixture
def inches() -> Iterator[None]:
    token = frame._NOW.set(Frame(units=INCH))
    yield
    frame._NOW.reset(token)


def got(running: Served, path: str, units: str = INCH) -> str:
    with as_user(running, "vera") as client:
        answer = client.get(path, headers={"Cookie": f"{client.headers['Cookie']}; abbe_units={units}"})
    assert answer.status_code == 200, answer.text
    return html.unescape(answer.text)


def read(text: str) -> float:
    return float(text.replace("−", "-"))


def agree(pair: tuple[str, str], value: float, expanded: float, before: float = 0.0) -> bool:
    """Value and U have two significant digits of U, and nothing else was done to them; ``before``: how finely both were known."""
    step = 10.0 ** (math.floor(math.log10(read(pair[1]))) - 1)
    allowed = 0.5001 * step + before
    return abs(read(pair[0]) - value) <= allowed and abs(read(pair[1]) - expanded) <= allowed


def test_every_node_of_the_map_and_its_picture(running: Served) -> None:
    address = f"/volume?id={running.filled.solution}&nodes=3"
    page = got(running, address)
    with as_user(running, "vera") as client:
        told = client.get(f"/api/v1/solutions/{running.filled.solution}/field", params={"nodes": 3}).json()
    rows = [re.findall(r"<td[^>]*>([^<]*)", row) for row in re.findall(r"<tr>(<td>.*?)</tr>", page)]
    places = [(x, y, z) for x in told["x_mm"] for y in told["y_mm"] for z in told["z_mm"]]
    compared = 0
    for cells, place, d, u in zip(rows, places, told["deviation_um"], told["expanded_um"], strict=True):
        assert np.allclose([read(c) for c in cells[:3]], [v / IN for v in place], atol=6e-5)
        for cell, value, expanded in zip(cells[3:7], [*d, math.hypot(*d)], u, strict=True):
            pair = tuple(cell.split(" ± "))
            compared += pair[1] != "0"
            assert pair[1] == "0" or agree((pair[0], pair[1]), value / UIN, expanded / UIN, 1e-3 / UIN), cell
    assert compared > 90
    assert re.findall(r'class="n">(.*?)</th>', page)[:4] == ["X in", "Y in", "Z in", "dX ± U µin"]
    largest = max(math.hypot(*d) for d in told["deviation_um"]) / UIN
    figure = re.findall(rf"<dd>{PAIR} µin", page)[0]
    assert figure in [tuple(cells[6].split(" ± ")) for cells in rows]
    assert read(figure[0]) == max(read(cells[6].split(" ± ")[0]) for cells in rows)
    top = float(re.findall(r'data-top="([\d.]+)"', page)[0])
    assert largest <= top < 1.4 * largest
    assert f"five steps from 0 to {top:g} µin" in page
    assert f'data-place="in" data-place-size="{IN}" data-error="µin" data-error-size="{UIN}"' in page
    picture = re.findall(r"<figure class=\"card wide\">\s*(<svg.*?</svg>)", page, re.DOTALL)[0]
    assert len(re.findall(r"\) in: [\d.]+ µin, U = [\d.]+ µin", picture)) == 9
    assert f"{top:g} µin" in picture
    assert ("X in" in picture, "X mm" in picture) == (True, False)
    assert re.search(rf"Plane XY at Z = {round(told['z_mm'][1] / IN, 4):g} in", picture)
    assert "µm" not in re.sub(r"<ul class=\"lines\">.*?</ul>", "", page, flags=re.DOTALL)  # reasons were stored in words
    # What a script asks for stays as it is, and so does the address.
    sources = [re.findall(r'data-source="([^"]*)"', one)[0] for one in (page, got(running, address, METRIC))]
    assert sources[0] == sources[1]


def test_a_prediction(running: Served) -> None:
    record, one = running.store.solutions.get(running.filled.solution), observed(running)
    page = got(running, f"/whatif?id={record.id}&take={one}")
    outcomes = forecast(stored_field(running.store, record), [one])
    rows = [re.findall(PAIR, row) for row in re.findall(r"<tr><th scope=\"row\">.*?</tr>", page)]
    for pairs, o in zip(rows, outcomes, strict=True):
        wanted = ((o.before_mm, o.u_before_mm), (o.after_mm, o.u_after_mm), (o.gain_mm, o.u_gain_mm))
        known = [(pair, v, u) for pair, (v, u) in zip(pairs, wanted, strict=True) if u > 1e-7]
        assert len(known) >= 2
        assert all(pair[1] == "0" for pair, (_, u) in zip(pairs, wanted, strict=True) if u < 1e-7), o.name  # rounding of the draws
        assert all(agree(pair, v / IN * 1e6, 2 * u / IN * 1e6) for pair, v, u in known), o.name
    assert page.count("± U [µin]") == 3
    picture = SVG.findall(page)[-1]
    assert ("µin" in picture, "µm" in picture) == (True, False)
    slopes = r"mean (?:slope|squareness), [−\d.]+ ± [\d.]+ (?:µm/m|µrad)"
    before = got(running, f"/whatif?id={record.id}&take={one}", METRIC)
    assert re.findall(slopes, page) == re.findall(slopes, before) != []
    assert re.findall(r'value="([^"]*)" checked', page) == re.findall(r'value="([^"]*)" checked', before) == [one]


def test_the_budget(running: Served) -> None:
    doc = running.store.solutions.get(running.filled.solution).doc
    page = got(running, f"/budget?id={running.filled.solution}")
    sizes = dict(re.findall(r'<td class="words">(.*?)</td><td class="n">([\d.]+)</td>', page))
    for b in doc["uncertainty"]["budget"]:
        assert read(sizes[b["words"]]) == pytest.approx(b["u_um"] / UIN, rel=0.051), b["source"]
    worst = doc["uncertainty"]["worst_point"]
    row = r'<th scope="row">d[XYZ]</th>' + 4 * r'<td class="n">(.*?)</td>' + "<td>µin</td>"
    told = re.findall(row, page)
    assert len(told) == 3
    for (value, half, low, high), v, u in zip(told, worst["deviation_um"], worst["expanded_um"], strict=True):
        assert agree((value, half), v / UIN, u / UIN)
        assert agree((low, half), (v - u) / UIN, u / UIN)
        assert agree((high, half), (v + u) / UIN, u / UIN)
    place = ", ".join(f"{round(v / IN, 4):g}" for v in worst["at_mm"])
    assert f"({place}) in, 95 %".replace("-", "−") in page
    vector = re.findall(r"reaches ± ([\d.]+) µin", page)
    assert read(vector[0]) == pytest.approx(worst["expanded_vector_um"] / UIN, rel=0.051)
    means = r'<th scope="row">[A-Z0]{3}</th>.*?<td>(?:µm/m|µrad)</td>'
    assert re.findall(means, page) == re.findall(means, got(running, f"/budget?id={running.filled.solution}", METRIC)) != []
    assert "contribution in µin" in page
    assert "µm" not in re.sub(r'µm/m|<td class="words">.*?</td>', "", page)  # the words of a source were stored


def test_the_picture_of_a_result_has_the_unit_of_its_table(running: Served) -> None:
    page = got(running, f"/result?id={running.filled.solution}")
    name, value = re.findall(r'data-motion="(\w+)"><th scope="row"><a [^>]*>\w+</a></th><td class="n">([\d.]+)</td>', page)[0]
    drawn = re.findall(rf"{name} ([\d.]+) ± [\d.]+ µin", SVG.findall(page)[0])
    assert read(drawn[0]) == pytest.approx(read(value), rel=0.03)
    assert "contribution in µin" in page


def test_compared_runs(running: Served) -> None:
    records = [running.store.runs.find(n) for n in runs_of(running, "ballbar_helix")[1:3]]
    page = got(running, "/compare?" + "&".join(f"run={r.id}" for r in records))
    loaded = []
    for record in records:
        run, document = run_document(running.store, record, Rules())
        loaded.append(LoadedRun(record.label, "m", run, run_data(run), document.figures))
    for row in figure_rows(loaded):
        size = {"µm": UIN, "mm": IN}.get(row.unit, 1.0)
        cells = re.findall(PAIR, re.findall(rf'<th scope="row">{re.escape(row.symbol)}</th>.*?</tr>', page)[0])
        for pair, (value, u) in zip(cells, [*row.values, (row.difference, row.u)], strict=False):
            assert value is not None
            assert u is not None
            assert agree(pair, value / size, 2 * u / size), row
    values = curve(loaded[0]).deviation_um / UIN
    low, high = re.findall(r"A: (−?[\d.]+) to ([\d.]+) µin", page)[0]
    assert (read(low), read(high)) == pytest.approx((values.min(), values.max()), rel=0.006)
    assert re.search(rf"Largest difference {PAIR} µin", page)
    assert "deviation in µin" in page
    assert "µm" not in page


@pytest.mark.usefixtures("inches")
def test_compared_lines() -> None:
    x, y, u = np.array([0.0, 254.0, 508.0]), np.array([0.0, 2.54, -5.08]), np.full(3, 0.254)
    lines = [ComparedCurve(False, x, k * y, u, x[:, None]) for k in (1.0, 2.0)]
    shown = pictures(lines, RunDifference(x, y, u), lambda key, **values: language.translate("en", key, **values))
    both, apart = (str(svg) for svg, _ in shown)
    assert "A: −200 … 100 µin; B: −400 … 200 µin" in both
    assert ": 200 µin." in apart
    for svg in (both, apart):
        assert "along the line in in" in svg
        assert "deviation in µin" in svg
        marks = [read(m) for m in re.findall(r'class="t-soft" text-anchor="middle">([−\d.]+)<', svg)]
        assert max(marks) == 20.0, "the line of 508 mm ends at 20 in"


@pytest.mark.usefixtures("inches")
def test_a_dry_run() -> None:
    dry = PLANS.run("quick-check", 100, Unit("in", IN))
    assert dry is not None
    told = SimpleNamespace(job=None, next_due=[])
    known = {"bar": strip_of(None), "choices": PLANS.choices(), "chosen": "quick-check", "rates_hz": PLANS.rates_hz, "rate_hz": 100}
    known |= {
        "max_feed": TOLD.max_feed_mm_min,
        "may_measure": True,
        "guided": False,
        "alarm": 0,
        "begins": None,
        "interrupted": None,
        "resumes": False,
        "key": "k",
        "expired": [],
        "temperature_c": None,
    }
    page = html.unescape(environment().get_template("new.html").render(machine="m", zone="UTC", status=told, dry=dry, **known))
    assert f"{dry.fastest_mm_min / IN:.2f} in/min (Limit {6000 / IN:.2f})" in page
    for _, low, high, least, most in dry.used:
        assert f"{low / IN:.2f} … {high / IN:.2f} in (Limit {least / IN:.2f} … {most / IN:.2f})" in page
    for run in dry.runs:
        row = re.findall(rf'<th scope="row">{re.escape(run.label)}</th>.*?</tr>', page)[0]
        assert f'<td class="n">{run.path_mm / IN:.2f}</td><td class="n">{run.fastest_mm_min / IN:.2f}</td>' in row
    for one in dry.set_ups:
        assert "X {:.3f} Y {:.3f} Z {:.3f} in".format(*(v / IN for v in one.at_mm)) in page
    assert f"Bar of {dry.set_ups[0].radius_mm / IN:.2f} in, cup at" in page
    assert ("[in]" in page, "[in/min]" in page, re.search(r"\bmm\b", page)) == (True, True, None)
    # What the full campaign has mounted is told, not ticked off.
    full = PLANS.run(CAMPAIGN, 100, Unit("in", IN))
    assert full is not None
    known |= {"chosen": CAMPAIGN, "guided": True, "may_propose": True}
    led = html.unescape(
        environment().get_template("new.html").render(machine="m", zone="UTC", status=told, dry=replace(full, startable=True), **known)
    )
    mounts = re.findall(r"<li>((?:Bar|Laser).*)</li>", led)
    for one, line in zip(full.set_ups, mounts, strict=True):
        assert "X {:.3f} Y {:.3f} Z {:.3f} in".format(*(v / IN for v in one.at_mm)) in line
        assert (f"Bar of {one.radius_mm / IN:.2f} in," in line) == (one.what == "bar")
    assert re.search(r"\bmm\b", led) is None
    # The drawing is the same; its grid stands at round inches.
    metric = PLANS.run("quick-check", 100, MM)
    assert metric is not None
    paths = [re.findall(r"<polyline[^>]*>", one.picture) for one in (dry, metric)]
    assert paths[0] == paths[1] != []


@pytest.mark.usefixtures("inches")
def test_a_live_run_gives_its_script_the_unit() -> None:
    now = datetime(2026, 11, 22, 6, tzinfo=UTC)
    job = RunningCheck(id="0123456789ab", schedule="", recipe="quick-check", since_utc=now)
    moment = SimpleNamespace(job=job, next_due=[], alarms=(), now_utc=now)
    words = script_texts("en")
    screen = environment().get_template("live.html")
    page = html.unescape(screen.render(bar=strip_of(None), machine="m", zone="UTC", status=moment, may_measure=True, texts=words))
    assert f'data-unit="µin" data-size="{UIN}"' in page
    assert re.findall(r"</span> (µ\w+)", page) == ["µin", "µin"]
    assert "µm" not in page
    assert "±{n} {unit}" in words["live.share_here"]
