"""Map of the volume, what-if, budget and compared runs by HTTP: numbers are those of the solution, what cannot be told is refused."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from abbe.models.functions.motions import motion_names
from abbe.models.geometry.volume import unit_deviation, volume_frame
from abbe.models.verification import U_REPEAT_MM
from abbe.service.domain.machine import Rules, machine_from_doc
from abbe.service.domain.solution_file import StoredPrediction
from abbe.service.runs.observations import run_data
from abbe.service.verification.compare_runs import LoadedRun, RunDifference, curve, difference, remarks
from abbe.service.web.api.results import Motion
from abbe.service.web.pages.runs import run_document
from tests.pages_world import Served, as_user


def statuses(running: Served) -> dict[str, str]:
    return {name: told["status"] for name, told in running.store.solutions.get(running.filled.solution).doc["motions"].items()}


def observed(running: Served) -> str:
    return next(name for name, status in statuses(running).items() if status == "observed")


def hidden(running: Served) -> str:
    return next(name for name, status in statuses(running).items() if status == "not observable")


def got(running: Served, path: str, status: int = 200) -> str:
    with as_user(running, "vera") as client:
        answer = client.get(path)
    assert answer.status_code == status, answer.text
    return html.unescape(answer.text)


def test_the_interface_answers_the_map_with_the_whole_covariance(running: Served) -> None:
    number = running.filled.solution
    with as_user(running, "vera") as client:
        told = client.get(f"/api/v1/solutions/{number}/field", params={"nodes": 3}).json()
    doc = running.store.solutions.get(number).doc
    terms, coefficients, covariance = StoredPrediction.read(doc["prediction"]).unpacked()
    machine = machine_from_doc(running.store.machines.all()[-1].doc | doc["machine"])
    points = np.array([[x, y, z] for x in told["x_mm"] for y in told["y_mm"] for z in told["z_mm"]])
    d = unit_deviation(machine, terms, points, None, volume_frame(machine))
    assert np.allclose(told["deviation_um"], 1e3 * d @ coefficients, atol=6e-4)
    variance = np.einsum("mik,kl,mil->mi", d, covariance, d, optimize=True) + doc["prediction"]["scatter_mm"] ** 2
    assert np.allclose(np.array(told["expanded_um"])[:, :3], 2e3 * np.sqrt(variance), atol=6e-4)
    covariances = np.einsum("mik,kl,mjl->mij", d, covariance, d, optimize=True) + doc["prediction"]["scatter_mm"] ** 2 * np.eye(3)
    off = d @ coefficients
    far = np.einsum("mi,mij,mj->m", off, np.linalg.inv(covariances), off)
    assert told["significant"] == (far > chi2.ppf(0.95, 3)).tolist()
    assert any(told["significant"])
    assert {h["motion"] for h in told["hidden"]} == {n for n, s in statuses(running).items() if s == "not observable"}
    assert set(told["motions"]) == set(statuses(running))


def test_a_motion_that_does_not_show_by_itself_is_asked_for_in_vain(running: Served) -> None:
    number, lost = running.filled.solution, hidden(running)
    with as_user(running, "vera") as client:
        answer = client.get(f"/api/v1/solutions/{number}/field", params={"motion": [observed(running), lost]})
        assert (answer.status_code, answer.json()["code"]) == (409, "SOL-001")
        assert answer.json()["detail"].startswith(f"solution {number} cannot separate {lost} from other motions")
        for wrong in ({"motion": "EQX"}, {"nodes": 1}, {"nodes": 10}):
            assert client.get(f"/api/v1/solutions/{number}/field", params=wrong).status_code == 422
        assert client.get("/api/v1/solutions/999/field").status_code == 404
    assert set(Motion.__args__) == {m for axis in "XYZ" for m in motion_names(axis)} | {"C0Y", "B0Z", "A0Z"}


def test_the_map_names_what_is_not_in_it_and_every_node_has_its_u(running: Served) -> None:
    number, lost, one = running.filled.solution, hidden(running), observed(running)
    page = got(running, f"/volume?id={number}&nodes=3")
    rows = re.findall(r"<tr>(<td>.*?)</tr>", page)
    assert len(rows) == 27
    assert all(row.count(" ± ") == 4 for row in rows)
    unknown = sum("not known" in row for row in rows)
    assert (f"At {unknown} of 27 nodes" in page) == (unknown > 0)
    assert f"<strong>{lost}</strong>: " in page
    assert re.search(rf'value="{lost}" disabled', page)
    part = got(running, f"/volume?id={number}&nodes=3&motion={one}&motion={lost}&motion=nonsense")
    left = re.search(r"Left out of this map[^:]*: ([^.]*)\.", part)
    assert left is not None
    assert lost in left.group(1).split(", ")
    assert f'field?nodes=3&motion={one}"' in part


@pytest.mark.parametrize("plane", ["XY", "XZ", "YZ"])
def test_a_slice_shows_its_plane(running: Served, plane: str) -> None:
    page = got(running, f"/volume?id={running.filled.solution}&nodes=4&plane={plane}&at=3")
    assert re.search(rf"Plane {plane} at {({'X', 'Y', 'Z'} - set(plane)).pop()} = -?[\d.]+ mm", page)
    picture = re.search(r"<figure class=\"card wide\">\s*<svg.*?</svg>", page, re.DOTALL)
    assert picture is not None
    assert len(re.findall(r"U = [\d.]+ µm", picture.group())) == 16


def test_a_prediction_is_asked_only_for_what_shows_by_itself(running: Served) -> None:
    number, lost, one = running.filled.solution, hidden(running), observed(running)
    page = got(running, f"/whatif?id={number}&take={one}")
    rows = re.findall(r"<tr><th scope=\"row\">([^<]*)</th>(.*?)</tr>", page)
    assert [name for name, _ in rows] == [
        "Volume, RMS", "Volume, largest", "Diagonal ppp", "Diagonal npp", "Diagonal pnp", "Diagonal ppn", "Helix RMS"
    ]  # fmt: skip
    assert all(row.count(" ± ") == 3 for _, row in rows)
    refused = got(running, f"/whatif?id={number}&take={lost}", 409)
    assert f"{lost} cannot be taken as corrected alone: " in refused
    assert "Volume, RMS" not in refused
    assert "no such motion" in got(running, f"/whatif?id={number}&take=EQX", 409)
    assert "EYY is chosen twice" in got(running, f"/whatif?id={number}&take=EYY&take=mean.EYY", 409)
    linear = got(running, f"/whatif?id={number}&take=mean.C0Y&take=mean.EXX")
    assert re.search(r'value="mean.C0Y" checked> C0Y mean squareness, [−\d.]+ ± [\d.]+ µrad', linear)
    assert re.search(r'<td class="(pass|fail|cannot-tell)">(better|worse|cannot tell)</td>', linear)
    everything = got(running, f"/whatif?id={number}&everything=true")
    assert "Volume, RMS" in everything
    plain = got(running, f"/whatif?id={number}")
    assert plain.count("nothing chosen") == 7
    assert re.search(rf'value="{lost}" disabled', plain)


def test_the_budget_has_type_freedom_and_intervals(running: Served) -> None:
    doc = running.store.solutions.get(running.filled.solution).doc
    page = got(running, f"/budget?id={running.filled.solution}")
    lines = doc["uncertainty"]["budget"]
    assert {b["source"] for b in lines if b["type"] == "A"} == {"bar_noise", "laser_noise", "estimated_sizes"}
    for b in lines:
        assert b["words"] in page
        assert (b["dof"] is not None) <= (b["type"] == "A"), b
    assert page.count("<td>A</td>") == 3
    assert page.count("<td>B</td>") == len(lines) - 3
    worst = doc["uncertainty"]["worst_point"]
    value, low, high = (
        float(v.replace("−", "-"))
        for v in re.findall(
            r'<th scope="row">dX</th><td class="n">(.*?)</td><td class="n">.*?</td><td class="n">(.*?)</td><td class="n">(.*?)</td>', page
        )[0]
    )
    half = worst["expanded_um"][0]  # shown to two digits, like the value: to 1 um from 10 um on
    assert (low, high) == pytest.approx((value - half, value + half), abs=0.11 if half < 9.95 else 1.1)
    assert "not checked by trials" in page


def runs_of(running: Served, test: str) -> list[int]:
    return [r.id for r in running.store.runs.all() if r.test == test and r.visible_status == "complete"]


def test_runs_of_one_kind_are_compared_and_others_refused(running: Served) -> None:
    about_x, a, b, *_ = runs_of(running, "ballbar_helix")
    assert "they ran along different paths" in got(running, f"/compare?run={about_x}&run={a}", 409)
    page = got(running, f"/compare?run={a}&run={b}")
    assert "Polar plot" in page
    assert "B − A" in page
    assert re.search(r"Largest difference [−\d.]+ ± [\d.]+ µm; beyond its U at \d+% of the positions", page)
    assert re.search(r"<th scope=\"row\">helix rms</th>.*? ± .*? ± .*? ± ", page)
    assert re.search(r"was measured elsewhere than", page)
    laser = runs_of(running, "laser_linear")[0]
    refused = got(running, f"/compare?run={a}&run={laser}", 409)
    assert "only runs of one test can be compared" in refused
    assert "<polyline" not in refused
    lines = "&".join(f"run={n}" for n in runs_of(running, "laser_linear")[:2])
    assert "they ran along different paths" in got(running, f"/compare?{lines}", 409)
    other = next(r.id for r in running.store.runs.all() if r.campaign == "c1" and r.label == "r01")
    assert "runs of two machines cannot be compared" in got(running, f"/compare?run={laser}&run={other}", 409)
    sealed = next(r.id for r in running.store.runs.all() if r.campaign == "c1" and r.label == "r04")
    assert "it is sealed" in got(running, f"/compare?run={other}&run={sealed}", 409)
    assert "No run 999 in the store" in got(running, f"/compare?run={a}&run=999", 409)
    many = "&".join(f"run={n}" for n in range(1, 6))
    assert "At most 4 runs" in got(running, f"/compare?{many}", 409)
    chooser = got(running, f"/compare?run={laser}")
    offered = {int(n) for n in re.findall(r'name="run" value="(\d+)"', chooser)}
    assert offered
    assert all(running.store.runs.find(n).test == "laser_linear" for n in offered)


def test_a_difference_counts_the_mounting_and_names_direction_and_feed(running: Served) -> None:
    record = running.store.runs.find(runs_of(running, "ballbar_helix")[0])
    run, document = run_document(running.store, record, Rules())
    one = LoadedRun("a", "m", run, run_data(run), document.figures)
    columns = replace(run.columns, direction=-run.columns.direction, feed_mm_min=2.0 * run.columns.feed_mm_min)
    other = LoadedRun("b", "m", replace(run, columns=columns), one.data, document.figures)
    told = remarks([one, other])
    assert ["another direction" in told[0], "effects of the feed" in told[1], len(told), remarks([one, one])] == [True, True, 2, []]
    found = difference(curve(one), curve(one))
    assert found is not None
    assert found.u_um.min() > np.sqrt(2.0) * U_REPEAT_MM * 1e3
    nothing = RunDifference(np.arange(2.0), np.array([1.0, 1.0]), np.array([0.0, 2.0]))
    assert (nothing.beyond, np.isnan(RunDifference(nothing.x, nothing.difference_um, np.zeros(2)).beyond)) == (0.0, True)


def test_a_run_compared_with_itself_measured_again_differs_by_nothing(running: Served) -> None:
    a = runs_of(running, "laser_diagonal")[0]
    assert "B − A" not in got(running, f"/compare?run={a}&run={a}")  # the same run twice is one run


def test_every_run_of_a_solution_leads_to_its_screen(running: Served) -> None:
    page = got(running, f"/result?id={running.filled.solution}").partition('id="h-runs"')[2]
    links = re.findall(r'<th scope="row"><a href="/run\?id=(\d+)">([^<]*)</a></th>', page)
    assert len(links) == page.count('<th scope="row">') > 5
    assert all(running.store.runs.find(int(number)).label == label for number, label in links)
