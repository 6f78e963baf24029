"""Recipe files: what is written is read back the same; what cannot run is refused in one line; the plan is what the sequencer moves."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS
from abbe.models.planning.measurements import DiagonalTest, HelixTest, Instruments, LineTest, laser_path, machine_seconds
from abbe.models.planning.plan import PlanStep
from abbe.service.campaigns.plan import describe, plan_for, plan_report, read_instruments, recipe_of
from abbe.service.cli.app import app
from abbe.service.devices.session import DeviceUrls
from abbe.service.domain.machine import machine_doc
from abbe.service.errors import AbbeError, ConfigError
from abbe.service.rendering.document_page import document_html
from abbe.service.sequences.check import dry_run, dry_run_campaign
from abbe.service.sequences.recipes.recipe import Circle, Diagonal, FaceDiagonal, Helix, HelixPoints, Linear
from abbe.service.sequences.recipes.recipe_file import parse_recipe, read_recipe, recipe_text, shared_setups
from abbe.service.sequences.steps import CampaignPlan, ChangeBar, MountBar, MountLaser, MoveTo, RecordPath, TakeBarOut, Unmount
from abbe.service.site import Site

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]))
ONE_BAR = Instruments(bar_lengths_mm=(150.0,))
"""For what does not depend on the bar: fewer helices to choose from."""
names = st.text("abcXYZ019-_ äµ", min_size=1, max_size=12).filter(lambda s: s == s.strip())
millimetres = st.floats(-2000.0, 2000.0, allow_nan=False)
roles = st.sampled_from(["identify", "holdout"])
helices = st.builds(
    Helix,
    names,
    names,
    roles,
    st.tuples(millimetres, millimetres, millimetres),
    st.floats(1.0, 2000.0),
    turns=st.floats(3.0, 50.0),
    law=st.sampled_from(["area", "angle"]),
    axis=st.integers(0, 2),
    direction=st.sampled_from([1, -1]),
    opens=st.sampled_from([1, -1]),
    length_calibrated=st.booleans(),
    u_length_mm=st.floats(0.0, 1.0),
    rate_hz=st.sampled_from([50, 100, 1000]),
)
diagonals = st.builds(
    Diagonal, names, names, roles, st.sampled_from(list(DIAGONALS)), st.integers(1, 500), st.sampled_from(["XYZ", "ZYX", ""])
)
share = st.floats(0.0, 1.0)
again = {"cycles": st.integers(1, 50), "overrun_mm": st.floats(0.0, 8.0)}
lines = st.builds(
    Linear,
    names,
    names,
    roles,
    st.integers(0, 2),
    positions=st.integers(5, 1000),
    at_share=st.tuples(share, share),
    offset_share=st.just(0.3),
    **again,
)
faces = st.builds(
    FaceDiagonal, names, names, roles, st.sampled_from(["XY", "YZ", "ZX"]), st.sampled_from(["pp", "np"]), at_share=share, **again
)
cups = (names, names, roles, st.tuples(millimetres, millimetres, millimetres), st.floats(1.0, 2000.0))
places = st.builds(HelixPoints, *cups, points=st.integers(20, 2000), samples=st.integers(1, 1000), settle_s=st.floats(0.0, 60.0))
angle = st.floats(0.0, 360.0)
circles = st.builds(
    Circle, *cups, st.sampled_from(["XY", "YZ", "ZX"]), angle, st.floats(30.0, 720.0), angle, angle, direction=st.sampled_from([1, -1])
)
recipe = helices | diagonals | lines | faces | places | circles


@settings(deadline=None, max_examples=60)
@given(st.lists(recipe, min_size=1, max_size=5, unique_by=(lambda r: r.label, lambda r: r.setup_id)), names)
def test_any_campaign_comes_back_from_its_file_as_it_went_in(recipes, name):
    told = shared_setups(tuple(recipes), "f")
    assert parse_recipe(recipe_text(name, told, "a note"), "f") == (name, told)


def site() -> Site:
    return Site("m", MACHINE, machine_doc("m", MACHINE), DeviceUrls())


@pytest.fixture(scope="module")
def planned():
    return plan_for(site(), minutes=12.0, tools=ONE_BAR)


def test_a_plan_written_and_read_is_the_same_campaign(planned, tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(planned.text)
    name, recipes = read_recipe(path)
    assert CampaignPlan(name, tuple(r.plan(MACHINE) for r in recipes)) == planned.campaign


def test_the_sequencer_moves_where_the_planner_thinks_and_takes_as_long(planned):
    for step, run, test, dry in zip(planned.plan.steps, planned.plan.runs, planned.campaign.tests, planned.dry, strict=True):
        path = np.array([p for s in test.steps if isinstance(s, RecordPath) for p in s.points_mm])
        near = np.linalg.norm(path[None] - run.axes_mm[::40, None], axis=2).min(axis=1) if len(path) else np.zeros(1)
        assert near.max() < 1.0  # chords of the path are a millimetre long
        assert dry.duration_s == pytest.approx(machine_seconds(MACHINE, step.test, Instruments()), rel=0.02, abs=1.5)


@pytest.mark.parametrize("test", [DiagonalTest("pnp", "YZX"), DiagonalTest("ppp", ""), LineTest(1, (0.1, 0.9)), LineTest(2, (0.5, 0.5))])
def test_laser_positions_are_those_of_the_sequencer(test):
    plan = recipe_of(PlanStep("a", "S1", test, 0.0, 0.0, 0.0, 0.0), Instruments()).plan(MACHINE)
    moves = [s.target_mm for s in plan.steps if isinstance(s, MoveTo)][1:]
    path, beam = laser_path(MACHINE, test)
    kept = path[np.r_[True, np.abs(np.diff(path, axis=0)).max(axis=1) > 0]]
    assert moves == pytest.approx(kept, abs=1e-5)
    assert next(s for s in plan.steps if isinstance(s, MountLaser)).beam == pytest.approx(beam)
    assert dry_run(MACHINE, plan).duration_s == pytest.approx(machine_seconds(MACHINE, test, Instruments()), abs=1.0)


def test_one_set_up_is_mounted_once_and_its_bar_changed_at_the_standing_cup():
    cup = (300.0, 250.0, 50.0)
    recipes = (
        Helix("a", "S1", "identify", cup, 150.0),
        Helix("b", "S1", "identify", cup, 100.0),
        Helix("c", "S1", "identify", cup, 100.0, direction=-1),
        Diagonal("d", "S2", "identify", "ppp", 6, "XYZ"),
        Diagonal("e", "S2", "identify", "ppp", 6, ""),
    )
    by_hand = MountBar | TakeBarOut | ChangeBar | MountLaser | Unmount
    plans = [r.plan(MACHINE) for r in shared_setups(recipes, "f")]
    done = [type(s).__name__ for p in plans for s in p.steps if isinstance(s, by_hand)]
    assert done == ["MountBar", "TakeBarOut", "ChangeBar", "Unmount", "MountLaser", "Unmount"]
    dry_run_campaign(MACHINE, CampaignPlan("n", tuple(plans)))


@pytest.mark.parametrize("direction", [1, -1])
def test_the_bar_is_out_while_the_machine_moves_and_hung_in_where_its_path_starts(direction):
    cup = (300.0, 250.0, 50.0)
    first, second = Helix("a", "S1", "identify", cup, 150.0), Helix("b", "S1", "identify", cup, 60.0, turns=4.5, direction=direction)
    plans = [r.plan(MACHINE) for r in shared_setups((first, second), "f")]
    here, radius, hung = np.zeros(3), 0.0, 0
    for step in (s for p in plans for s in p.steps):
        if isinstance(step, MoveTo):
            if radius:  # on the sphere, within the stroke of the bar
                assert np.linalg.norm(np.array(step.target_mm) - cup) == pytest.approx(radius, abs=1.0)
            elif hung:  # past the cup, not through it
                t = np.linspace(0.0, 1.0, 200)[:, None]
                assert np.linalg.norm(here + t * (np.array(step.target_mm) - here) - cup, axis=1).min() > 30.0
            here = np.array(step.target_mm)
        elif isinstance(step, RecordPath):
            here, radius = np.array(step.points_mm[-1]), np.linalg.norm(np.array(step.points_mm[-1]) - cup)
        elif isinstance(step, TakeBarOut):
            radius, hung = 0.0, hung + 1
        elif isinstance(step, ChangeBar):
            radius = step.radius_mm
            assert np.linalg.norm(here - cup) == pytest.approx(radius, abs=1.0)
    assert hung == 1


def test_a_bar_is_as_well_known_as_the_instruments_file_says(tmp_path):
    (tmp_path / "i.toml").write_text("bar_length_u_um = 0.7\nlaser = false\nbar_lengths_mm = [150.0]\n")
    found = plan_for(site(), minutes=5.0, tools=read_instruments(tmp_path / "i.toml"))
    recipes = parse_recipe(found.text, "f")[1]
    assert {r.plan(MACHINE).bar.u_length_mm for r in recipes} == {0.0007}
    loose = Helix("a", "S1", "identify", (300.0, 250.0, 50.0), 150.0, length_calibrated=False, u_length_mm=0.05)
    assert parse_recipe(recipe_text("n", (loose,)), "f")[1][0].plan(MACHINE).bar.length_calibrated is False
    assert Helix("a", "S1", "identify", (300.0, 250.0, 50.0), 150.0).plan(MACHINE).bar.u_length_mm == 0.002


def test_a_slow_machine_gets_a_plan_that_it_may_run():
    found = plan_for(replace(site(), max_feed_mm_min=1000.0), minutes=7.0, tools=ONE_BAR)
    feeds = {s.feed_mm_min for t in found.campaign.tests for s in t.steps if isinstance(s, MoveTo | RecordPath)}
    assert feeds == {1000.0}
    assert {r.feed_mm_min for r in parse_recipe(found.text, "f")[1]} == {1000.0}
    assert sum(d.duration_s for d in found.dry) / 60.0 < found.plan.minutes


@pytest.mark.parametrize(
    ("named", "kinds", "says"), [("ballbar", {Helix}, "without a laser"), ("laser", {Diagonal, Linear}, "without a ball-bar")]
)
def test_only_what_the_machine_file_names_is_planned(named, kinds, says):
    found = plan_for(replace(site(), urls=DeviceUrls(**{named: "x"})), minutes=7.0, tools=ONE_BAR)
    assert {type(r) for r in found.recipes} <= kinds
    assert says in found.notes[0]
    assert len(found.notes) == 2 + (named == "ballbar")  # of the judge; helices of a machine without tool_mm: where is the spindle?
    assert says in document_html(plan_report(site(), found))


def test_instruments_that_the_machine_does_not_have_are_refused():
    with pytest.raises(ConfigError, match="nothing to measure with"):
        plan_for(replace(site(), urls=DeviceUrls(laser="x")), minutes=9.0, tools=Instruments(laser=False))


GOOD = recipe_text("n", (Helix("a", "S1", "identify", (300.0, 250.0, 50.0), 150.0), Linear("l", "S2", "identify", 1, at_share=(0.1, 0.9))))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("radius_mm = 150.0", 'radius_mm = "150"', "test[1].radius_mm: expected a number"),
        ("radius_mm = 150.0", "radius_mm = nan", "test[1].radius_mm"),
        ("radius_mm", "radius", "did you mean 'radius_mm'"),
        ("turns = 5.0", "turns = 2.0", "test[1].turns"),
        ("rate_hz = 100", "rate_hz = 333", "divides 1000"),
        ('axis = "Y"', 'axis = "W"', "test[2].axis"),
        ("at_share = [0.1, 0.9]", "at_share = [0.1, 1.9]", "test[2].at_share[2]"),
        ('kind = "line"', 'kind = "lime"', "'line'"),
        ('kind = "line"\n', "", "key 'test[2].kind' is missing"),
        ("u_length_mm = 0.002", "u_length_mm = -0.002", "test[1].u_length_mm"),
        ("opens = 1", "opens = 2", "test[1].opens"),
        ('label = "l"', 'label = "a"', "labelled 'a'"),
        ('label = "l"', 'label = "a/b"', "test[2].label"),
        ('setup = "S2"', 'setup = "S1"', "cannot share set-up 'S1'"),
        ("abbe-recipe/1", "abbe-recipe/9", "format"),
        ('name = "n"', "name = ", "not valid TOML"),
        ("[[test]]", "[test]", "f.toml"),
        (GOOD, "", "missing"),
    ],
)
def test_a_bad_file_is_refused_in_one_line_that_says_where(old, new, says):
    with pytest.raises(ConfigError) as caught:
        parse_recipe(GOOD.replace(old, new), "f.toml")
    text = str(caught.value)
    assert text.startswith("f.toml")
    assert says in text
    assert "\n" not in text


def test_set_ups_that_cannot_be_shared_are_named():
    cup = (300.0, 250.0, 50.0)
    first = Helix("a", "S1", "identify", cup, 150.0)
    for second, says in (
        (Helix("b", "S1", "identify", (301.0, 250.0, 50.0), 150.0), "another cup"),
        (Helix("b", "S1", "identify", cup, 150.0, opens=-1), "another cup"),
        (Linear("b", "S1", "identify", 0, at_share=(0.15, 0.15)), "share a set-up"),
    ):
        with pytest.raises(ConfigError, match=says):
            shared_setups((first, second), "f")
    with pytest.raises(ConfigError, match="another alignment"):
        shared_setups((Diagonal("a", "D", "identify", "ppp"), Diagonal("b", "D", "identify", "npp")), "f")
    with pytest.raises(ConfigError, match="another line"):
        shared_setups((Linear("a", "L", "identify", 0, at_share=(0.15, 0.15)), Linear("b", "L", "identify", 1, at_share=(0.15, 0.15))), "f")
    low = Circle("a", "S1", "identify", (300.0, 250.0, 225.0), 150.0, "YZ", -90.0, 360.0, feed_in_deg=0.0, feed_out_deg=0.0)
    with pytest.raises(ConfigError, match="below the cup"):
        shared_setups((low, replace(low, label="b", radius_mm=100.0)), "f")
    with pytest.raises(ConfigError, match="taken down before"):
        shared_setups((first, Linear("b", "S2", "identify", 0, at_share=(0.15, 0.15)), Helix("c", "S1", "identify", cup, 100.0)), "f")


MACHINE_TOML = 'name = "m"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\nX = [0.0, 600.0]\nY = [0.0, 500.0]\nZ = [0.0, 450.0]\n'


def test_the_commands_plan_write_and_dry_run(tmp_path):
    machine, out, page = tmp_path / "m.toml", tmp_path / "p.toml", tmp_path / "p.html"
    machine.write_text(MACHINE_TOML)
    (tmp_path / "i.toml").write_text("bar_lengths_mm = [100.0, 150.0]\nlaser = false\n[setup]\ncup_min = 2.0\n")
    words = [
        "plan",
        "-m",
        str(machine),
        "--minutes",
        "9",
        "--out",
        str(out),
        "--picture",
        str(page),
        "--instruments",
        str(tmp_path / "i.toml"),
    ]
    found = CliRunner().invoke(app, [*words, "--goal-um", "1"])
    assert found.exit_code == 0, found.output
    assert "goal 1 µm is not reached" in found.output
    assert "this campaign cannot determine" in found.output
    assert {r.radius_mm for r in read_recipe(out)[1]} <= {100.0, 150.0}
    html = page.read_text()
    assert "<polyline" in html
    assert "http" not in html
    machine.write_text(MACHINE_TOML + '[devices]\ncnc = "modbus+tcp://h:1"\nballbar = "socket://h:1"\nfixture = "fixture+console:"\n')
    dry = CliRunner().invoke(app, ["measure", "-m", str(machine), "--recipe", str(out), "--dry-run"])
    assert dry.exit_code == 0, dry.output
    assert "of machine time" in dry.output
    assert read_recipe(out)[0] in dry.output  # the campaign is called what the recipe is called
    assert "temperature of the scales (standard uncertainty 0.2 K" in found.output
    assert "note: hemispheres open along +Z" in found.output


@pytest.mark.parametrize("out", [".", "", "m.toml/x.toml", "nowhere/x.toml", "m.toml", "./m.toml"])
@pytest.mark.parametrize("option", ["--out", "--picture"])
def test_a_file_that_cannot_be_written_is_one_line_before_anything_is_planned(tmp_path, monkeypatch, out, option):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.toml").write_text(MACHINE_TOML)
    found = CliRunner().invoke(app, ["plan", "-m", "m.toml", "--minutes", "60", option, out])
    assert isinstance(found.exception, ConfigError) or found.exit_code == 2
    assert (tmp_path / "m.toml").read_text() == MACHINE_TOML


def test_an_instruments_file_is_not_called_a_machine_file(tmp_path):
    with pytest.raises(ConfigError, match=f"instruments file {tmp_path} cannot be read"):
        read_instruments(tmp_path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("bar_length_mm = [100.0]", "did you mean 'bar_lengths_mm'"),
        ("laser_noise_um = -1.0", "laser_noise_um"),
        ("bar_lengths_mm = []\nlaser = false", "neither a ball-bar nor a laser"),
        ("[setup]\ncup_min = 'three'", "setup.cup_min"),
        ("[setup]\ncups_min = 3.0", "did you mean 'cup_min'"),
    ],
)
def test_an_instruments_file_says_what_is_wrong_in_it(tmp_path, text, says):
    path = tmp_path / "i.toml"
    path.write_text(text + "\n")
    with pytest.raises(AbbeError, match=says):
        read_instruments(path)


def test_instruments_default_to_the_planners_own():
    assert read_instruments(None) == Instruments()


def test_too_few_minutes_are_one_clear_line():
    with pytest.raises(ConfigError, match="no measurement fits into 1 minutes"):
        plan_for(site(), minutes=1.0)


def test_words_for_the_operator_name_every_kind():
    assert describe(HelixTest((1.0, 2.0, 3.0), 150.0)) == "ball-bar 150 mm about (1, 2, 3)"
    assert describe(HelixTest((1.0, 2.0, 3.0), 150.0, axis=1, opens=-1)) == "ball-bar 150 mm about (1, 2, 3), opening along -Y"
    assert describe(LineTest(1, (0.1, 0.9))) == "laser along Y, X at 10 %, Z at 90 % of the stroke"
    assert describe(DiagonalTest("ppp", "")) == "laser, body diagonal ppp, straight"
