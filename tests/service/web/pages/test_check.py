"""The screen of one check by HTTP: what it says of the machine, its figures, the last good check, and where it leads."""

from __future__ import annotations

import re

from tests.pages_world import Served, as_user


def text(page: str) -> str:
    """What a person reads on a screen."""
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page.partition("<main")[2]))


def test_a_failed_check_has_its_figures_curves_alarm_and_report(running: Served) -> None:
    with as_user(running, "olga") as client:
        page = client.get("/check?id=24").text
        shown = text(page)
        assert "✖ fail Above the limit by more than U (k = 2): Body diagonal." in shown
        assert "Body diagonal 21.6 ± 1.1 µm · Limit 20 µm · ✖ fail" in shown
        assert "Change since check 20: +3.4 ± 1.6 µm" in shown
        assert page.count('class="gauge"') == 3
        assert re.search(r'aria-label="Body diagonal: 21.6 ± 1.1 µm, limit 20 µm"', page)
        both = re.findall(r"<svg[^>]*>.*?</svg>", page.partition('class="curves"')[2], re.DOTALL)
        assert len(both) >= 4
        assert all("check 20" in one and "this check" in one for one in both), "each curve stands over that of the last good check"
        assert 'href="/alarm?id=2"' in page
        report = re.search(r'href="(/api/v1/reports/verification/24)"', page)
        assert report is not None
        assert client.get(report[1]).content.startswith(b"%PDF")


def test_a_check_that_could_not_be_completed_says_why_and_what_to_do(running: Served) -> None:
    with as_user(running, "olga", **{"Accept-Language": "ja"}) as client:
        shown = text(client.get("/check?id=22").text)
        assert "点検は完了しませんでした。" in shown
        assert "レーザーの電源は入っていますか。" in shown
        assert "測定データが保存されていません" in shown
        assert client.get("/check?id=999").status_code == 404
        assert 'href="/check?id=24"' in client.get("/").text


def test_runs_searches_and_pushes_have_their_report_too(running: Served) -> None:
    with as_user(running, "olga") as client:
        for path, report in (("/run?id=8", "run/8"), (f"/discovery?id={running.filled.discovery}", "discovery/")):
            address = re.search(rf'href="(/api/v1/reports/{report}[0-9]*)"', client.get(path).text)
            assert address is not None, path
            assert client.get(address[1]).status_code == 200, address[1]
        assert 'href="/api/v1/reports/push/2"' in client.get("/table").text


def test_every_mention_of_a_check_leads_to_it(running: Served) -> None:
    with as_user(running, "olga") as client:
        for path in ("/", "/alarm?id=2"):
            assert 'href="/check?id=24"' in client.get(path).text, path
        plain = re.search(r'<p id="still"><a class="button" href="([^"]+)"', client.get("/trends").text)
        assert plain is not None, "a browser that draws nothing finds the pictures"
        assert 'data-href="/check?id=24"' in client.get(plain[1]).text


def test_the_live_screen_gets_the_path_of_the_last_good_check(running: Served) -> None:
    with as_user(running, "olga") as client:
        assert client.get("/live/before?run=helix").json()["values"] == [], "nothing is measured"
        running.board.job_started(running.filled.schedules[0], running.store.utcnow())
        try:
            labels = [run.label for run in running.store.runs.all() if run.test == "ballbar_helix"]
            told = client.get("/live/before", params={"run": labels[0]}).json()
            assert told["check"] == 20
            assert len(told["values"]) == 250, "two readings in each part"
            assert all(isinstance(value, float) for value in told["values"])
            assert client.get("/live/before?run=other").json()["values"] == []
        finally:
            running.board.job_ended(None)
