"""Hidden cases: what a seed draws, what is written, and that nothing written reveals what is hidden."""

import ast
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.import_checks import ALLOWED_PACKAGES, VALIDATION, find_forbidden_imports

from torchcloth import recordings
from torchcloth.diagnosis.causes.hypotheses import list_known_hypotheses
from torchcloth.training.studies import hidden_rates
from torchcloth.training.validation.hidden import case_sampling, rerun_case
from torchcloth.training.validation.hidden.case_sampling import (
    DEVELOPMENT_SEEDS,
    FAMILY_CYCLE,
    FAST_SIZE,
    FIRST_SEALED_SEED,
    HiddenEffect,
    draw_case,
    draw_sealed_seeds,
)
from torchcloth.training.validation.hidden.effect_map import (
    EXCLUDED_EFFECTS,
    OUTSIDE_EFFECTS,
    PAIRED_EFFECTS,
    SINGLE_EFFECTS,
)
from torchcloth.training.validation.hidden.make_case import main, make_episode, make_scenes
from torchcloth.training.validation.hidden.recording_faults import FAULTS
from torchcloth.training.validation.hidden.reveal_truth import reveal_truth
from torchcloth.training.validation.hidden.visibility import measure_visibility, rms
from torchcloth.training.validation.independent.effects import CATALOGUE
from torchcloth.training.validation.independent.motions import TABLE_MOTIONS, make_motion
from torchcloth.training.validation.independent.scene import recorded_poses
from torchcloth.training.validation.independent.sensor import pinhole_camera

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
    allowed = (*ALLOWED_PACKAGES, *(f"{VALIDATION}.hidden.{module}" for module in TRUTH_MODULES))
    assert find_forbidden_imports(source, f"{VALIDATION}.hidden", allowed) == []
    assert any(isinstance(node, ast.Import | ast.ImportFrom) for node in ast.walk(ast.parse(source)))


def test_every_effect_of_the_engine_is_mapped_and_every_name_is_the_librarys():
    assert SINGLE_EFFECTS.keys() | EXCLUDED_EFFECTS.keys() | OUTSIDE_EFFECTS.keys() == CATALOGUE.keys()
    names = {h.effect for h in list_known_hypotheses()} | {
        kin for h in list_known_hypotheses() for kin in h.structurally_equivalent
    }
    assert {name for p in SINGLE_EFFECTS.values() for name in p.names} <= names
    assert not names & OUTSIDE_EFFECTS.keys()
    assert {name for pair in PAIRED_EFFECTS for name in pair} <= SINGLE_EFFECTS.keys()


def test_amplitudes_are_the_librarys_typical_ones():
    """A cause that is hidden below what the library looks for could never be identified."""
    typical = {h.effect: abs(h.typical) for h in list_known_hypotheses()}
    for name, mapping in SINGLE_EFFECTS.items():
        amplitude = abs(CATALOGUE[name].typical if mapping.typical is None else mapping.typical)
        assert amplitude == pytest.approx(typical[mapping.names[0]]), name


def test_twenty_seeds_hold_the_families_in_their_proportions():
    case = Counter(draw_case(seed).family for seed in draw_sealed_seeds(5, 40))
    assert case == {family: 2 * count for family, count in Counter(FAMILY_CYCLE).items()}
    assert Counter(draw_case(seed).family for seed in range(20)) == Counter(FAMILY_CYCLE)


def test_sealed_and_development_seeds_are_disjoint_and_more_may_be_added():
    assert min(draw_sealed_seeds(5, 100)) >= FIRST_SEALED_SEED > DEVELOPMENT_SEEDS
    assert draw_sealed_seeds(5, 60)[:25] == draw_sealed_seeds(5, 25) != draw_sealed_seeds(6, 25)
    assert draw_case(3).is_sealed is False
    assert draw_case(FIRST_SEALED_SEED).is_sealed is True
    for seed in (-1, DEVELOPMENT_SEEDS, FIRST_SEALED_SEED - 1):
        with pytest.raises(ValueError, match="expected 0 to 999"):
            draw_case(seed)


def test_all_singles_come_up_at_all_amplitudes():
    singles = [draw_case(seed) for seed in range(DEVELOPMENT_SEEDS) if draw_case(seed).family == "single"]
    pairs = {(c.effects[-1].name, c.kind) for c in singles}
    assert {name for name, _ in pairs} == set(SINGLE_EFFECTS)
    assert Counter(kind for _, kind in pairs).keys() == {"0.5", "1", "1.5"}
    for c in singles:
        effect = c.effects[-1]
        typical = SINGLE_EFFECTS[effect.name].typical or CATALOGUE[effect.name].typical
        assert abs(effect.amplitude / typical) == pytest.approx(float(c.kind))
        made = {t.motion for t in c.episodes}
        assert {motion for motion, _, _ in SINGLE_EFFECTS[effect.name].required_motions} <= made
        assert not SINGLE_EFFECTS[effect.name].needs_table or made & set(TABLE_MOTIONS)


def test_nulls_hold_nothing_that_matters():
    for seed in range(0, 200, 20):
        matched, hard = draw_case(seed), draw_case(seed + 2)
        assert not matched.effects
        assert set(matched.data_sheet_ratio.values()) == {1.0}
        assert all(h.typical_fraction <= 0.2 for h in hard.effects)
        assert 0.4 <= hard.data_sheet_ratio["membrane_stiffness"] <= 2.5
        assert 0.5 <= hard.data_sheet_ratio["bending_stiffness"] <= 2.0
        shifts = [episode.effects[0].amplitude for episode in hard.episodes]
        assert np.abs(shifts).max() <= 4e-3
        assert len(set(shifts)) == len(shifts)
        quadrant = np.array([round(episode.heading / 90) for episode in hard.episodes])
        for heading in (0, 1):  # what all episodes shared would be a robot that stands elsewhere
            assert abs(np.mean(np.array(shifts)[quadrant == heading])) < 1e-12


def test_the_case_of_a_seed_is_always_the_same_and_its_order_reveals_nothing():
    assert draw_case(17) == draw_case(17)
    assert reveal_truth(draw_case(17)) == reveal_truth(draw_case(17))
    orders = {tuple(t.motion for t in draw_case(seed).episodes) for seed in range(0, 100, 20)}
    assert len(orders) > 2


@pytest.fixture(scope="module")
def tiny():
    """One short episode on coarse meshes."""
    motions = (("drag-fast", 0.0, 4.0),)
    return replace(FAST_SIZE, nodes=9, fit_nodes=5, hanging=motions, table=motions)


def test_an_episode_reveals_nothing_of_what_is_hidden(tiny, tmp_path):
    hidden, plain = draw_case(6, tiny), replace(draw_case(6, tiny), effects=())
    assert [h.name for h in hidden.effects] == ["air.drag_n"]
    one, two = (make_episode(c, c.episodes[0], 1) for c in (hidden, plain))
    for name, recording in (("a", one), ("b", two)):
        recordings.write(recording, tmp_path / name)
    assert (tmp_path / "a" / "episode.json").read_text() == (tmp_path / "b" / "episode.json").read_text()
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == sorted(p.name for p in (tmp_path / "b").iterdir())
    assert one.truth is None
    assert one.split["motion"] == "drag-fast"
    assert 1e-5 < np.abs(one.points.xyz[-250:] - two.points.xyz[-250:]).max() < 0.05  # but the cloth moved otherwise


def recorded_placement(case, episode):
    """Return what a recording reveals of its camera's pose and its gripper's start."""
    true, _ = make_scenes(case, episode)
    pose = recorded_poses(
        true.grip, make_motion(episode.motion, true.sheet, episode.heading, episode.speed, episode.start).pose["left"]
    )
    return [*pinhole_camera(true.sensor)["T_world_camera"].ravel(), *pose[0, :3, 3]]


@pytest.mark.parametrize("name", ["obs.extrinsic", "obs.rotation", "robot.base"])
def test_a_false_pose_is_within_the_spread_of_true_ones(name):
    """If all true poses were equal, a false one could be read off."""
    nulls = [c for c in map(draw_case, range(300)) if c.family == "null"]
    effects = case_sampling._draw_effect(name, 1.0, np.random.default_rng(7), SINGLE_EFFECTS)
    usual, wrong = (
        np.array([recorded_placement(c, episode) for c in cases for episode in c.episodes])
        for cases in (nulls, [replace(c, effects=effects) for c in nulls])
    )
    moved = wrong.mean(0) - usual.mean(0)
    assert np.abs(moved).max() > 1e-3
    assert (np.abs(moved) <= usual.std(0)).all()
    assert len(np.unique(usual[:, 3].round(6))) == len(nulls)  # each case has its own camera
    assert len(np.unique(usual[:, -3].round(6))) == len(usual)  # and each episode its own start


@pytest.mark.parametrize("name", ["obs.clock", "air.drag_n"])
def test_frames_are_as_many_whatever_is_hidden(tiny, name):
    case = draw_case(0, tiny)
    counts = set()
    for amplitude in (-0.045, 0.0, 0.045) if name == "obs.clock" else (0.0, 2.0):
        recording = make_episode(replace(case, effects=(HiddenEffect(name, amplitude),)), case.episodes[0], 1)
        counts.add((len(recording.points.t), len(recording.points.xyz)))
    assert len(counts) == 1


def test_motions_that_some_effects_need_are_made_for_others_as_well():
    """Cases on a table that hide neither creases nor friction have them as well."""
    tables = [
        c
        for c in map(draw_case, range(1000))
        if not {"drag-fast", "fold-open"}.isdisjoint(t.motion for t in c.episodes)
    ]
    plain = [c for c in tables if not {h.name for h in c.effects} & {"plast.crease", "contact.mu", "contact.aniso"}]
    for motion in ("fold-open", "drag"):
        cases_with_motion = [c for c in plain if any(e.motion == motion for e in c.episodes)]
        assert 0.1 < len(cases_with_motion) / len(plain) < 0.35


def test_tables_know_every_kind_of_confounded_case():
    assert hidden_rates.CONFOUNDED_KINDS == case_sampling.CONFOUNDED_KINDS


def test_two_base_offsets_add_up_as_vectors():
    """The later heading took the place of the earlier, and a hard null's robot was off otherwise in each episode."""
    case = next(c for c in map(draw_case, range(1000)) if c.family == "hard null" and c.effects[0].name == "robot.base")

    def vector(size, heading):
        return size * np.exp(1j * np.deg2rad(heading))

    (hidden,) = case.effects
    for episode in case.episodes:
        grip, (effect,) = make_scenes(case, episode)[0].grip, episode.effects
        both = vector(hidden.amplitude, hidden.options["heading"]) + vector(effect.amplitude, effect.options["heading"])
        assert vector(grip.base, grip.heading) == pytest.approx(both)


def test_the_data_sheet_is_off_and_the_fabric_is_not(tiny):
    case = draw_case(3, tiny)
    true, described = make_scenes(case, case.episodes[0])
    assert described.sheet.membrane_stiffness / true.sheet.membrane_stiffness == pytest.approx(
        case.data_sheet_ratio["membrane_stiffness"]
    )
    recording = make_episode(case, case.episodes[0], 1)
    assert recording.cloth.nominal["bending_stiffness"] == pytest.approx(described.plate.stiffness)
    assert recording.cloth.areal_density == pytest.approx(described.sheet.areal_density)
    ray = recording.cameras["cam0"].T_world_camera[:3, 2]
    assert ray @ (recording.points.xyz.mean(0) - recording.cameras["cam0"].T_world_camera[:3, 3]) > 0.8


def test_faults_change_what_they_say(tiny):
    case = draw_case(0, tiny)
    recording = make_episode(case, case.episodes[0], 1)
    faulty = {name: fault(recording, np.random.default_rng(1)) for name, fault in FAULTS.items() if name}
    assert 0.13 < np.diff(faulty["clock jump"].points.t).max() < 0.64
    assert faulty["swapped grippers"].grasps["left"].uv[0, 0] == recording.grasps["right"].uv[0, 0]
    heights = np.ptp(faulty["wrong unit"].points.xyz[:, 0]) / np.ptp(recording.points.xyz[:, 0])
    assert heights == pytest.approx(4.0) or heights == pytest.approx(0.25)
    assert faulty["mirrored"].points.xyz[:, 1] == pytest.approx(-recording.points.xyz[:, 1])
    assert {draw_case(18 + 20 * k).fault for k in range(4)} == faulty.keys()


def test_truths_name_what_is_right():
    wind = reveal_truth(draw_case(10))
    assert [(e["name"], e["is_enabling"]) for e in wind["effects"]] == [("air.drag_n", True), ("air.wind", False)]
    assert reveal_truth(draw_case(15))["confounded"]["causes"] == ["obs.extrinsic", "robot.base"]
    outside = reveal_truth(draw_case(16))
    assert outside["effects"][0]["names"] == []
    assert json.loads(json.dumps(wind)) == wind


def test_a_mass_fraction_is_relative_to_the_data_sheet():
    case = next(c for c in map(draw_case, range(DEVELOPMENT_SEEDS)) if c.kind == "mass without forces")
    (hidden,), sheet = case.effects, case.data_sheet_ratio["areal_density"]
    assert sheet != 1.0
    assert (1 + reveal_truth(case)["effects"][0]["amplitude"]) * sheet == pytest.approx(1 + hidden.amplitude)


def test_hypotheses_are_the_librarys_with_their_axes():
    names = {h.name for h in list_known_hypotheses()}
    for seed in range(DEVELOPMENT_SEEDS):
        for e in reveal_truth(draw_case(seed))["effects"]:
            assert e["hypothesis"] in names if e["names"] else e["hypothesis"] == ""


def test_wrong_seeds_are_refused_in_one_line(tmp_path, capsys):
    assert main(["--seed", "5000", "--out", str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err == "seed 5000: expected 0 to 999, or 100000 and more\n"
    assert not (tmp_path / "x").exists()


def test_a_sealed_case_is_not_diagnosed_again_and_again(capsys, tmp_path):
    assert rerun_case.main(["--seed", str(FIRST_SEALED_SEED), "--folder", str(tmp_path / "cases")]) == 2
    assert "sealed" in capsys.readouterr().err
    assert not (tmp_path / "cases").exists()


@pytest.mark.slow
def test_visibility_leaves_out_what_the_fabric_can_do():
    """Fast drag moves the cloth by millimetres, which no stiffness can do; weak internal friction hardly moves it."""
    small = replace(draw_case(6, FAST_SIZE), episodes=(case_sampling.EpisodePlan("swing-fast", 0.0, 1.3),))
    strong = measure_visibility(
        replace(small, effects=(HiddenEffect("air.drag_n", 1.2), HiddenEffect("obs.clock", 0.02)))
    )
    (weak,) = measure_visibility(replace(small, effects=(HiddenEffect("fric.internal_shear", 0.05),)))
    assert [row["name"] for row in strong] == ["air.drag_n"], "a clock does not move the cloth"
    assert 1e-3 < strong[0]["unexplained_displacement_rms_m"] <= strong[0]["displacement_rms_m"]
    assert weak["unexplained_displacement_rms_m"] < 3e-4


def test_means_are_split_by_kind():
    places, forces = np.full((3, 16, 3), 2.0), np.full((3, 2, 3), 4.0)
    assert rms(draw_case(6), np.concatenate([places.ravel(), forces.ravel()])) == pytest.approx((1e-3, 40e-3))
