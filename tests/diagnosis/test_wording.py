"""Sentences of a diagnosis."""

from types import SimpleNamespace

import pytest

from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.report.wording import collect_warnings, write_sentences

LIST_KEYS = ("causes", "initial_causes", "minor", "ruled_out", "wrong_sign", "undecided", "unresolvable")
LIST_KEYS = (*LIST_KEYS, "lack_of_fit", "force_drifts", "warnings")
OPTIONAL_KEYS = ("gain", "missing_force", "residual_force", "next_experiment")


def summary(verdict, **content):
    """With nothing else found."""
    blank = {key: [] for key in LIST_KEYS} | dict.fromkeys(OPTIONAL_KEYS) | {"also_unexplained": False}
    return write_sentences(verdict, blank | content)


def test_what_is_minor_is_said_with_what_it_cannot_be_told_from():
    scale = {"effect": "obs.depth_scale", "amplitude": -0.002, "unit": "-", "rivals": []}
    bias = {"effect": "obs.depth_bias", "amplitude": -2.5e-3, "unit": "m"}
    said = summary("inconclusive", minor=[scale | {"rivals": [bias]}, scale])
    assert sum("which would be relevant" in line for line in said) == 1
    assert any("obs.depth_bias = -0.0025 m" in line for line in said)


def test_without_forces_mass_is_said_to_be_unknown():
    def told(*kinds, **content):
        rows = [
            {"motion": "swing", "kind": kind, "rms_ratio": 1.0, "is_significant": False, "worst_window": None}
            for kind in kinds
        ]
        return any(
            "mass itself cannot be determined" in line for line in summary("adequate", lack_of_fit=rows, **content)
        )

    assert told("points", "edges")
    assert not told("points", "force", "torque")
    assert not told()  # nothing was simulated
    heavier = {"effect": "mass.density", "amplitude": 0.1, "unit": "-", "ci95": [0.05, 0.15]}
    assert not told("points", initial_causes=[heavier])  # the stiffness of the data sheet says so


@pytest.mark.parametrize(
    ("arms", "said"),
    [
        (None, "it tells."),
        ({"not_checked": "unknown robot"}, "it tells. The arms were not checked: unknown robot."),
        ({"slowdown": 1.0, "limited_by": "joint4 of left: velocity", "refused": {}}, "it tells. The arms can do it."),
        (
            {"slowdown": 1.83, "limited_by": "joint4 of left: velocity", "refused": {"turn": "out of reach"}},
            "it takes 1.8 times as long as asked (joint4 of left: velocity). 1 other is beyond them.",
        ),
    ],
)
def test_what_the_arms_can_do_is_said_with_the_next_experiment(arms, said):
    (line,) = (
        line for line in summary("ambiguous", next_experiment={"why": "it tells.", "arms": arms}) if "Next" in line
    )
    assert line.endswith(said)


@pytest.mark.parametrize("weights", [0.5, 70.0])
def test_a_force_that_nothing_has_is_doubted(weights):
    where = {"at": [0.1, 0.2], "from": 1.0, "to": 1.2}
    m = {
        "motion": "swing",
        "is_significant": True,
        "pressure": [0.0, 0.0, 3.0 * weights],
        "unstable_from": None,
        **where,
    }
    (line,) = (
        text for text in summary("unexplained", missing_force={"weight_pa": 3.0, "motions": [m]}) if "Pa" in text
    )
    assert f"{100 * weights:.0f} % of the cloth's own weight" in line
    assert ("Hardly anything exerts such a force" in line) is (weights > 10)


def test_drifts_are_told_with_what_would_tell_more():
    x = {"axis": "x", "rate": 0.001, "std": 0.004, "p_value": 1.0, "is_significant": False}
    z = {"axis": "z", "rate": -0.0196, "std": 0.0041, "p_value": 6e-6, "is_significant": True}
    (line,) = (line for line in summary("unexplained", force_drifts=[x, z]) if "drift" in line)
    assert line.startswith(
        "The force on each gripper along z drifts from the simulation's by -20 mN/s (standard error 4)"
    )
    assert "A recording of empty grippers" in line


def test_a_law_is_told_though_nothing_else_is_lacking():
    term = {
        "law": "bend@inside",
        "coefficient": 2.6e-4,
        "unit": "N m",
        "description": "opposes bending, far from the edges",
    }
    gain = {"rms_before": 1.28e-3, "rms_after": 0.71e-3, "unit": "m"}
    said = summary("unexplained", residual_force={"terms": [term], "path": [], "gain": gain})
    assert any("opposes bending, far from the edges (0.00026 N m)" in line for line in said)
    assert any("1.28 to 0.71 mm" in line for line in said)
    assert not any(line.startswith("Misfit") for line in said)


def test_what_lacks_in_one_stretch_of_time_only_is_said_to():
    def told(elsewhere):
        worst = {"from": 1.4, "to": 1.6, "ratio_elsewhere": elsewhere}
        row = {"motion": "swing", "kind": "points", "rms_ratio": 6.5, "is_significant": True, "worst_window": worst}
        return summary("unexplained", lack_of_fit=[row], force_drifts=[], missing_force=None, residual_force=None)

    assert "Misfit: points of swing (6.5 times the expected RMS, 1.2 except from 1.4 to 1.6 s)." in told(1.2)
    assert "Misfit: points of swing (6.5 times the expected RMS)." in told(4.0)


def test_numbers_without_a_unit_have_none():
    cause = {"effect": "air.drag_n", "amplitude": 1.19, "unit": "-", "ci95": [1.05, 1.32], "typical": 1.2}
    cause |= {"description": "", "equivalence_class": [], "rivals": [], "motions_disagree": False}
    cause |= {
        "when": {"episode": 0, "motion": "swing", "from": 0.4, "to": 0.6},
        "response": {"value": 0.0123, "unit": "m"},
    }
    cause |= {"where": {"at": [0.1, 0.25]}}
    said = summary("identified", causes=[cause], motions=["swing"])
    assert not any("By noise" in line for line in said)
    assert "Cause: air.drag_n = 1.19 (95 %: 1.05 to 1.32); 1.2 is typical." in said
    beyond = "beyond what fitted parameters could do instead"
    assert f"  Most significant in swing from 0.4 to 0.6 s, at (100, 250) mm of the pattern: 12.3 mm {beyond}." in said
    rival = {"effect": "air.wind[x]", "amplitude": 0.4, "unit": "m/s"}
    open_ = cause | {"description": "It pushes.", "equivalence_class": ["air.drag_n", "air.linear"], "rivals": [rival]}
    said = summary("ambiguous", causes=[open_], motions=["swing"])
    assert "  It pushes." in said
    assert "  Confounded with: air.linear, air.wind[x] = 0.4 m/s in its place." in said
    assert any("The extended model has the named cause" in line for line in said)
    felt = cause | {"where": {"gripper": "left"}, "response": {"value": 0.035, "unit": "N"}}
    said = summary("identified", causes=[felt], motions=["swing"])
    assert f"  Most significant in swing from 0.4 to 0.6 s, in the force on gripper left: 35 mN {beyond}." in said


@pytest.mark.parametrize("low", [-17.0, 2.0])
def test_a_cause_whose_interval_holds_zero_says_what_is_known_of_its_size(low):
    cause = {"effect": "elas.stiffen", "amplitude": 13.5, "unit": "-", "ci95": [low, 44.0], "typical": 10.0}
    cause |= {
        "description": "",
        "equivalence_class": [],
        "rivals": [],
        "noise_ci95": [12.4, 14.6],
        "effective_motions": 1.96,
        "motions_disagree": False,
    }
    cause |= {"when": {"episode": 0, "from": 0.4, "to": 0.6}, "response": {"value": 0.035, "unit": "N"}}
    said = summary("identified", causes=[cause | {"where": {"gripper": "left"}}], motions=["stretch"])
    told = [line for line in said if "2.0 effective motions" in line and "would be 12.4 to 14.6" in line]
    assert bool(told) == (low < 0)
    cause |= {"where": {"gripper": "left"}, "noise_ci95": [-1.0, 28.0]}
    said = summary("identified", causes=[cause], motions=["stretch"])
    assert any("leave the size open" in line for line in said) == (low < 0)
    assert not any("effective motions" in line for line in said)
    said = summary("identified", causes=[cause | {"motions_disagree": True}], motions=["stretch"])
    assert sum("Motions disagree about its size" in line for line in said) == 1


def test_what_would_have_the_wrong_sign_is_told_from_what_is_small():
    said = summary("adequate", ruled_out=["mass.hem", "air.drag_n"], wrong_sign=["air.drag_n"])
    assert "Absent, or below the smallest effect of interest: mass.hem." in said
    assert "Would need a sign that makes no sense: air.drag_n." in said


def test_what_cannot_be_seen_is_told_from_what_a_fitted_number_does():
    rows = [
        {"effect": name, "smallest_detectable": least, "unit": "-"}
        for name, least in (("air.drag_t", 0.05), ("mass.density", None))
    ]
    said = summary("adequate", unresolvable=rows)
    assert "Not detectable in these data: air.drag_t." in said
    assert "No effect here beyond what a fitted parameter does: mass.density." in said


def test_the_gain_is_told_with_its_intervals():
    gain = {"rms_before": 5e-3, "rms_after": 1e-3, "noise_floor": 5e-4, "explained_fraction": 0.97}
    gain |= {"explained_fraction_ci95": [0.9, 1.0]}
    gain |= {"log_density": 316.0, "log_density_ci95": [113.0, 493.0]}
    first, second, third, *_ = summary("identified", gain=gain, noise_floor={"source": "repetitions"})
    assert third.endswith("Single points are farther off.")
    assert first.endswith("1.00 mm with the causes below. The noise floor of repetitions is 0.50 mm.")
    assert second == (
        "The causes explain 97 % of what can be explained (95 %: 90 to 100 %), "
        "and gain 316 in log density (113 to 493)."
    )


def test_a_missing_force_is_a_pressure_at_a_place():
    part = {
        "motion": "swing",
        "at": [0.1, 0.2],
        "from": 0.2,
        "to": 0.4,
        "pressure": [0.0, 3.0, 4.0],
        "is_significant": True,
    }
    part["unstable_from"] = None
    (line,) = (t for t in summary("unexplained", missing_force={"weight_pa": 2.0, "motions": [part]}) if "missing" in t)
    assert (
        "A pressure of 5 Pa (250 % of the cloth's own weight) towards (0.0, 0.6, 0.8) of the world is missing" in line
    )
    assert "in swing, at about (100, 200) mm" in line
    lines = summary(
        "unexplained",
        missing_force={"weight_pa": 2.0, "motions": [part, part | {"motion": "hang", "unstable_from": 0.6}]},
    )
    assert (
        "  The missing force cannot be estimated where small forces have unbounded effects: hang from 0.6 s on."
        in lines
    )


def test_ripples_that_would_hide_a_lack_of_fit_are_warned_of():
    model = SimpleNamespace(strained_parameters=[], accepted=(), amplitudes=(), base=SimpleNamespace(), parameters=())
    model.base.cloth = SimpleNamespace(effects={"bending": None})
    fitted = SimpleNamespace(model=model)
    found = SimpleNamespace(
        start=fitted, end=fitted, data=SimpleNamespace(episodes=[]), replicate_floor=1, bifurcating_fraction=0.0
    )
    found.not_simulated = found.withdrawn = found.causes = found.scores = ()
    found.total_gain = None

    def warned(expected, stable=True):
        row = SimpleNamespace(
            motion="turn",
            kind="points",
            is_position=True,
            meshes_agree=stable,
            is_significant=False,
            expected_rms=expected,
        )
        return [text for text in collect_warnings(found, ["turn"] * 8, [row]) if "ripples" in text]  # type: ignore[arg-type]

    (text,) = warned(1.5 * CRITERIA.report.max_expected_rms_m)
    assert "in turn that a correct model might leave 15 mm of points" in text
    assert warned(0.5 * CRITERIA.report.max_expected_rms_m) == []
    assert warned(1.5 * CRITERIA.report.max_expected_rms_m, stable=False) == []  # said of the meshes already
