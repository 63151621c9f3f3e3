"""Hidden cases: what a number draws, what is written, and that nothing of it tells."""

import ast
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.import_checks import ALLOWED, VALIDATION, forbidden_imports

from torchcloth import recordings
from torchcloth.diagnosis.causes.hypotheses import known
from torchcloth.training.studies import hidden_rates
from torchcloth.training.validation.hidden import case_sampling, rerun_case
from torchcloth.training.validation.hidden.case_sampling import DEVELOPMENT, ROUND, SEALED, SMALL, Hidden, case, sealed
from torchcloth.training.validation.hidden.effect_map import LEFT_OUT, OUTSIDE, PAIRS, SINGLES
from torchcloth.training.validation.hidden.make_case import episode, main, scenes
from torchcloth.training.validation.hidden.recording_faults import FAULTS
from torchcloth.training.validation.hidden.reveal_truth import truth
from torchcloth.training.validation.hidden.visibility import rms, shown
from torchcloth.training.validation.independent.effects import CATALOGUE
from torchcloth.training.validation.independent.motions import LYING, motion
from torchcloth.training.validation.independent.scene import believed
from torchcloth.training.validation.independent.sensor import pinhole

FOLDER = Path(case_sampling.__file__).parent
TRUTH_MODULES = (
    "case_command",
    "case_sampling",
    "effect_map",
    "make_case",
    "recording_faults",
    "reveal_truth",
    "visibility",
)


@pytest.mark.parametrize("name", TRUTH_MODULES)
def test_the_truth_imports_nothing_that_it_judges(name):
    source = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    allowed = (*ALLOWED, *(f"{VALIDATION}.hidden.{module}" for module in TRUTH_MODULES))
    assert forbidden_imports(source, f"{VALIDATION}.hidden", allowed) == []
    assert any(isinstance(node, ast.Import | ast.ImportFrom) for node in ast.walk(ast.parse(source)))


def test_every_effect_of_the_generator_has_its_place_and_every_name_is_the_librarys():
    assert SINGLES.keys() | LEFT_OUT.keys() | OUTSIDE.keys() == CATALOGUE.keys()
    names = {h.effect for h in known()} | {kin for h in known() for kin in h.kin}
    assert {name for p in SINGLES.values() for name in p.names} <= names
    assert not names & OUTSIDE.keys()
    assert {name for pair in PAIRS for name in pair} <= SINGLES.keys()


def test_amplitudes_are_the_librarys_typical_ones():
    """A cause that is hidden below what the library looks for could never be found."""
    typical = {h.effect: abs(h.typical) for h in known()}
    for name, partner in SINGLES.items():
        own = abs(CATALOGUE[name].typical if partner.typical is None else partner.typical)
        assert own == pytest.approx(typical[partner.names[0]]), name


def test_twenty_numbers_hold_the_families_at_their_shares():
    found = Counter(case(seed).family for seed in sealed(5, 40))
    assert found == {family: 2 * count for family, count in Counter(ROUND).items()}
    assert Counter(case(seed).family for seed in range(20)) == Counter(ROUND)


def test_sealed_and_development_numbers_are_disjoint_and_more_may_be_added():
    assert min(sealed(5, 100)) >= SEALED > DEVELOPMENT
    assert sealed(5, 60)[:25] == sealed(5, 25) != sealed(6, 25)
    assert case(3).sealed is False
    assert case(SEALED).sealed is True
    for seed in (-1, DEVELOPMENT, SEALED - 1):
        with pytest.raises(ValueError, match="expected 0 to 999"):
            case(seed)


def test_all_singles_come_up_at_all_amplitudes():
    singles = [case(seed) for seed in range(DEVELOPMENT) if case(seed).family == "single"]
    drawn_ = {(c.effects[-1].name, c.kind) for c in singles}
    assert {name for name, _ in drawn_} == set(SINGLES)
    assert Counter(kind for _, kind in drawn_).keys() == {"0.5", "1", "1.5"}
    for c in singles:
        own = c.effects[-1]
        typical = SINGLES[own.name].typical or CATALOGUE[own.name].typical
        assert abs(own.amplitude / typical) == pytest.approx(float(c.kind))
        made = {t.motion for t in c.takes}
        assert {motion for motion, _, _ in SINGLES[own.name].shown} <= made
        assert not SINGLES[own.name].table or made & set(LYING)


def test_nulls_hold_nothing_that_matters():
    for seed in range(0, 200, 20):
        matched, hard = case(seed), case(seed + 2)
        assert not matched.effects
        assert set(matched.said.values()) == {1.0}
        assert all(h.share <= 0.2 for h in hard.effects)
        assert 0.4 <= hard.said["membrane_stiffness"] <= 2.5
        assert 0.5 <= hard.said["bending_stiffness"] <= 2.0
        shifts = [take.own[0].amplitude for take in hard.takes]
        assert np.abs(shifts).max() <= 4e-3
        assert len(set(shifts)) == len(shifts)
        alike = np.array([round(take.heading / 90) for take in hard.takes])
        for heading in (0, 1):  # what all episodes shared would be a robot that stands elsewhere
            assert abs(np.mean(np.array(shifts)[alike == heading])) < 1e-12


def test_the_case_of_a_number_is_always_the_same_and_order_tells_nothing():
    assert case(17) == case(17)
    assert truth(case(17)) == truth(case(17))
    orders = {tuple(t.motion for t in case(seed).takes) for seed in range(0, 100, 20)}
    assert len(orders) > 2


@pytest.fixture(scope="module")
def tiny():
    """One short episode on coarse meshes."""
    plans = (("drag-fast", 0.0, 4.0),)
    return replace(SMALL, nodes=9, fit=5, free=plans, table=plans)


def test_an_episode_says_nothing_of_what_it_holds(tiny, tmp_path):
    hidden, plain = case_sampling.case(6, tiny), replace(case_sampling.case(6, tiny), effects=())
    assert [h.name for h in hidden.effects] == ["air.drag_n"]
    one, two = (episode(c, c.takes[0], 1) for c in (hidden, plain))
    for name, recording in (("a", one), ("b", two)):
        recordings.write(recording, tmp_path / name)
    assert (tmp_path / "a" / "episode.json").read_text() == (tmp_path / "b" / "episode.json").read_text()
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == sorted(p.name for p in (tmp_path / "b").iterdir())
    assert one.truth is None
    assert one.split["motion"] == "drag-fast"
    assert 1e-5 < np.abs(one.points.xyz[-250:] - two.points.xyz[-250:]).max() < 0.05  # but the cloth moved otherwise


def places(found, take):
    """What a recording says of where its camera and its grippers are, to a micrometre."""
    true, _ = scenes(found, take)
    pose = believed(true.grip, motion(take.motion, true.sheet, take.heading, take.speed, take.start).pose["left"])
    return [*pinhole(true.sensor)["T_world_camera"].ravel(), *pose[0, :3, 3]]


@pytest.mark.parametrize("name", ["obs.extrinsic", "obs.rotation", "robot.base"])
def test_a_false_pose_cannot_be_told_from_the_true_ones_of_others(name):
    """Where all true ones are alike, false ones can be read off."""
    nulls = [c for c in map(case, range(300)) if c.family == "null"]
    effects = case_sampling._hide(name, 1.0, np.random.default_rng(7), SINGLES)
    usual, wrong = (
        np.array([places(c, take) for c in cases for take in c.takes])
        for cases in (nulls, [replace(c, effects=effects) for c in nulls])
    )
    moved = wrong.mean(0) - usual.mean(0)
    assert np.abs(moved).max() > 1e-3
    assert (np.abs(moved) <= usual.std(0)).all()
    assert len(np.unique(usual[:, 3].round(6))) == len(nulls)  # each has its own camera
    assert len(np.unique(usual[:, -3].round(6))) == len(usual)  # and each episode its own start


@pytest.mark.parametrize("name", ["obs.clock", "air.drag_n"])
def test_frames_are_as_many_whatever_is_hidden(tiny, name):
    found = case_sampling.case(0, tiny)
    counts = set()
    for amplitude in (-0.045, 0.0, 0.045) if name == "obs.clock" else (0.0, 2.0):
        recording = episode(replace(found, effects=(Hidden(name, amplitude),)), found.takes[0], 1)
        counts.add((len(recording.points.t), len(recording.points.xyz)))
    assert len(counts) == 1


def test_motions_that_some_effects_need_are_made_for_others_as_well():
    """By cases on a table that hide nothing that creases or rubs."""
    tables = [c for c in map(case, range(1000)) if not {"drag-fast", "fold-open"}.isdisjoint(t.motion for t in c.takes)]
    plain = [c for c in tables if not {h.name for h in c.effects} & {"plast.crease", "contact.mu", "contact.aniso"}]
    with_one = lambda motion: sum(any(t.motion == motion for t in c.takes) for c in plain) / len(plain)  # noqa: E731
    assert 0.1 < with_one("fold-open") < 0.35
    assert 0.1 < with_one("drag") < 0.35


def test_tables_know_every_kind_of_confounded_case():
    assert hidden_rates.CONFOUNDED == case_sampling.CONFOUNDED


def test_robots_that_are_off_in_two_ways_are_off_by_their_sum():
    """The later heading took the place of the earlier, and a hard null's robot was off otherwise in each episode."""
    found = next(c for c in map(case, range(1000)) if c.family == "hard null" and c.effects[0].name == "robot.base")
    along = lambda size, heading: size * np.exp(1j * np.deg2rad(heading))  # noqa: E731
    (hidden,) = found.effects
    for take in found.takes:
        grip, (own,) = scenes(found, take)[0].grip, take.own
        both = along(hidden.amplitude, hidden.options["heading"]) + along(own.amplitude, own.options["heading"])
        assert along(grip.base, grip.heading) == pytest.approx(both)


def test_the_data_sheet_is_off_and_the_fabric_is_not(tiny):
    found = case_sampling.case(3, tiny)
    true, said = scenes(found, found.takes[0])
    assert said.sheet.membrane_stiffness / true.sheet.membrane_stiffness == pytest.approx(
        found.said["membrane_stiffness"]
    )
    recording = episode(found, found.takes[0], 1)
    assert recording.cloth.nominal["bending_stiffness"] == pytest.approx(said.plate.stiffness)
    assert recording.cloth.areal_density == pytest.approx(said.sheet.areal_density)
    ray = recording.cameras["cam0"].T_world_camera[:3, 2]
    assert ray @ (recording.points.xyz.mean(0) - recording.cameras["cam0"].T_world_camera[:3, 3]) > 0.8


def test_faults_change_what_they_say(tiny):
    found = case_sampling.case(0, tiny)
    good = episode(found, found.takes[0], 1)
    bad = {name: fault(good, np.random.default_rng(1)) for name, fault in FAULTS.items() if name}
    assert 0.13 < np.diff(bad["clock jump"].points.t).max() < 0.64
    assert bad["swapped grippers"].grasps["left"].uv[0, 0] == good.grasps["right"].uv[0, 0]
    heights = np.ptp(bad["wrong unit"].points.xyz[:, 0]) / np.ptp(good.points.xyz[:, 0])
    assert heights == pytest.approx(4.0) or heights == pytest.approx(0.25)
    assert bad["mirrored"].points.xyz[:, 1] == pytest.approx(-good.points.xyz[:, 1])
    assert {case_sampling.case(18 + 20 * k).fault for k in range(4)} == bad.keys()


def test_truths_name_what_is_right():
    wind = truth(case(10))
    assert [(e["name"], e["beside"]) for e in wind["effects"]] == [("air.drag_n", True), ("air.wind", False)]
    assert truth(case(15))["confounded"]["like"] == ["obs.extrinsic", "robot.base"]
    outside = truth(case(16))
    assert outside["effects"][0]["names"] == []
    assert json.loads(json.dumps(wind)) == wind


def test_a_share_of_mass_is_one_of_what_the_data_sheet_says():
    found = next(c for c in map(case, range(DEVELOPMENT)) if c.kind == "mass without forces")
    (hidden,), sheet = found.effects, found.said["areal_density"]
    assert sheet != 1.0
    assert (1 + truth(found)["effects"][0]["amplitude"]) * sheet == pytest.approx(1 + hidden.amplitude)


def test_hypotheses_are_the_librarys_with_their_axes():
    names = {h.name for h in known()}
    for seed in range(DEVELOPMENT):
        for e in truth(case(seed))["effects"]:
            assert e["hypothesis"] in names if e["names"] else e["hypothesis"] == ""


def test_wrong_numbers_are_refused_in_one_line(tmp_path, capsys):
    assert main(["--seed", "5000", "--out", str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err == "seed 5000: expected 0 to 999, or 100000 and more\n"
    assert not (tmp_path / "x").exists()


def test_a_sealed_case_is_not_diagnosed_again_and_again(capsys, tmp_path):
    assert rerun_case.main(["--seed", str(SEALED), "--keep", str(tmp_path / "cases")]) == 2
    assert "sealed" in capsys.readouterr().err
    assert not (tmp_path / "cases").exists()


def test_how_much_an_effect_shows_is_told_beside_what_the_fabric_does():
    """Drag at speed moves the cloth by millimetres, and no stiffness does that; internal friction hardly does."""
    small = replace(case(6, SMALL), takes=(case_sampling.Take("swing-fast", 0.0, 1.3),))
    strong = shown(replace(small, effects=(case_sampling.Hidden("air.drag_n", 1.2), case_sampling.Hidden("obs.clock", 0.02))))
    (weak,) = shown(replace(small, effects=(case_sampling.Hidden("fric.internal_shear", 0.05),)))
    assert [row["name"] for row in strong] == ["air.drag_n"], "a clock moves no cloth"
    assert 1e-3 < strong[0]["left_moves"] <= strong[0]["moves"]
    assert weak["left_moves"] < 3e-4


def test_means_are_told_apart_by_kind():
    places, forces = np.full((3, 16, 3), 2.0), np.full((3, 2, 3), 4.0)
    assert rms(case(6), np.concatenate([places.ravel(), forces.ravel()])) == pytest.approx((1e-3, 40e-3))
