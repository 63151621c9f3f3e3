"""How the hidden round is scored, on answers written by hand."""

import pytest

from torchcloth.training.studies import hidden_rates as rates
from torchcloth.training.studies.hidden_scores import observable_effects, score_case
from torchcloth.training.studies.hidden_tables import describe_durations, to_markdown


def hidden(family, *effects, kind="1", **more):
    """A truth; an effect is (name, amplitude) or (name, amplitude, names)."""
    full = [
        {
            "name": n,
            "amplitude": a,
            "names": list(rest[0]) if rest else [n],
            "sign": 1.0,
            "is_enabling": False,
            "hypothesis": n,
        }
        for n, a, *rest in effects
    ]
    return {
        "seed": 3, "sealed": False, "family": family, "kind": kind, "effects": full, "confounded": None, "fault": "",
        "right_for_fault": [],
    } | more  # fmt: skip


def cause(effect, amplitude=1.0, confounded=(), rivals=(), ci95=None):
    return {
        "effect": effect, "amplitude": amplitude, "unit": "-", "equivalence_class": sorted({effect, *confounded}),
        "rivals": [{"effect": r, "amplitude": 1.0, "unit": "-"} for r in rivals],
        "ci95": list(ci95 or (amplitude - 0.1, amplitude + 0.1)),
    }  # fmt: skip


def answer(*causes, verdict="identified", **more):
    return {"verdict": verdict, "causes": list(causes), "unresolvable": [], "undecided": []} | more


DRAG = hidden("single", ("air.drag_n", 1.2))


def test_a_null_is_right_when_nothing_is_named():
    assert score_case(hidden("null"), answer(verdict="adequate"))["right"]
    assert score_case(hidden("null"), answer(verdict="unexplained"))["right"]
    assert not score_case(hidden("hard null"), answer(verdict="invalid_data"))["right"], "sound episodes are refused"
    alarm = score_case(hidden("null"), answer(cause("air.linear")))
    assert not alarm["right"]
    assert alarm["named"] == ["air.linear"]
    # what is there, but too small to matter, is no cause either
    assert not score_case(hidden("hard null", ("air.linear", 0.2)), answer(cause("air.linear")))["right"]


def test_a_single_is_found_by_name_or_class_and_covered_by_rivals():
    by_name = score_case(DRAG, answer(cause("air.drag_n", 1.26, ci95=(1.1, 1.3))))
    assert by_name["right"]
    assert by_name["amplitudes"] == [{"error": pytest.approx(0.05), "inside": True}]
    by_class = score_case(DRAG, answer(cause("air.linear", confounded=["air.drag_n"])))
    assert (by_class["right"], by_class["covered"], by_class["wrong"]) == (True, [True], False)
    by_rival = score_case(DRAG, answer(cause("air.linear", rivals=["air.drag_n"]), verdict="ambiguous"))
    assert (by_rival["right"], by_rival["covered"], by_rival["wrong"]) == (False, [True], False)
    assert by_rival["sizes"] == [2]
    assert by_rival["amplitudes"] == [None]


def test_one_cause_is_not_both_of_two_effects():
    both = hidden("double", ("air.drag_n", 1.2), ("air.linear", 2.0), kind="two")
    vague = score_case(both, answer(cause("air.drag_n", 1.2, confounded=["air.linear", "damp.bend"])))
    assert (vague["identified"], vague["right"]) == ([True, False], False)
    both_named = score_case(both, answer(cause("air.linear", 2.0, confounded=["air.drag_n"]), cause("air.drag_n", 1.2)))
    assert (both_named["identified"], both_named["right"]) == ([True, True], True)
    assert [a["error"] for a in both_named["amplitudes"]] == pytest.approx([0.0, 0.0])


def test_the_order_of_an_answer_does_not_matter():
    """Damping could stand for both effects, the hem for drag alone: listed first, damping was taken for drag."""
    two = hidden("double", ("air.drag_n", 1.0), ("air.linear", 1.0))
    causes = [cause("damp.bend", confounded=["air.drag_n", "air.linear"]), cause("mass.hem", confounded=["air.drag_n"])]
    for listed in (causes, causes[::-1]):
        found = score_case(two, answer(*listed))
        assert (found["identified"], found["right"]) == ([True, True], True)
    named = [cause("air.linear", confounded=["air.drag_n"]), cause("air.drag_n", confounded=["air.linear"])]
    assert score_case(two, answer(*named))["amplitudes"] == [{"error": 0.0, "inside": True}] * 2


def test_an_axis_is_no_other_name_and_counts_once():
    tilt = hidden("single", ("env.gravity_tilt", 0.01))
    found = score_case(tilt, answer(cause("env.gravity_tilt[x]", 0.011, confounded=["env.gravity_tilt[y]"])))
    assert (found["right"], found["sizes"], found["wrong"]) == (True, [1], False)


def test_alone_and_false_is_confident_and_wrong_even_beside_what_is_right():
    wrong = score_case(DRAG, answer(cause("mass.hem")))
    assert (wrong["right"], wrong["wrong"], wrong["spurious"], wrong["covered"]) == (False, True, 1, [False])
    both = score_case(DRAG, answer(cause("air.drag_n", 1.2), cause("mass.hem")))
    assert (both["right"], both["wrong"], both["spurious"]) == (True, True, 1)
    unsure = score_case(DRAG, answer(cause("mass.hem", rivals=["mass.seam"])))
    assert (unsure["wrong"], unsure["spurious"]) == (False, 1)


def test_what_a_wind_needs_is_no_false_cause():
    wind = hidden("single", ("air.wind", 0.3))
    wind["effects"].insert(0, hidden("", ("air.drag_n", 1.2))["effects"][0] | {"is_enabling": True})
    found = score_case(wind, answer(cause("air.wind[x]", 0.3), cause("air.drag_n", 1.2)))
    assert (found["right"], found["wrong"], found["spurious"]) == (True, False, 0)
    only = score_case(wind, answer(cause("air.drag_n", 1.2)))
    assert (only["right"], only["wrong"]) == (False, False)


def test_signs_are_the_librarys():
    late = hidden("single", ("obs.clock", 0.03))
    late["effects"][0]["sign"] = -1.0
    off = score_case(late, answer(cause("obs.clock", -0.033, ci95=(-0.036, -0.031))))["amplitudes"]
    assert off == [{"error": pytest.approx(0.1), "inside": False}]
    late["effects"][0]["sign"] = 0.0
    assert score_case(late, answer(cause("obs.clock", 0.5)))["amplitudes"] == [None]


def test_both_of_two():
    pair = hidden("double", ("air.drag_n", 1.2), ("mass.hem", 0.02))
    assert score_case(pair, answer(cause("mass.hem", 0.02), cause("air.drag_n", 1.2)))["right"]
    one = score_case(pair, answer(cause("mass.hem", 0.02)))
    assert (one["right"], one["identified"]) == (False, [False, True])


LIKE = {"confounded": {"causes": ["env.gravity_tilt", "air.wind"], "may_be_separable": False}}


@pytest.mark.parametrize(
    ("said", "right"),
    [
        (answer(cause("env.gravity_tilt[x]", rivals=["air.wind[x]"]), verdict="ambiguous"), True),
        (answer(cause("air.wind[x]", rivals=["env.gravity_tilt[x]"]), verdict="ambiguous"), True),
        (answer(cause("env.gravity_tilt[x]")), False),  # confident where nobody can be
        (answer(cause("air.wind[x]", rivals=["mass.hem"])), False),
        (answer(verdict="inconclusive", undecided=["env.gravity_tilt[x]"]), True),
        (answer(verdict="adequate", unresolvable=[{"effect": "env.gravity_tilt[x]"}]), True),
        (answer(verdict="adequate"), False),
        ({"failed": "Killed"}, False),
    ],
)
def test_confounded_cases_ask_for_doubt(said, right):
    assert score_case(hidden("confounded", ("env.gravity_tilt", 0.01), **LIKE), said)["right"] is right


def test_where_the_data_might_tell_its_name_alone_is_right():
    soft = hidden(
        "confounded", ("air.linear", 1.0), confounded={"causes": ["air.linear", "air.drag_n"], "may_be_separable": True}
    )
    assert score_case(soft, answer(cause("air.linear")))["right"]
    assert not score_case(soft, answer(cause("air.drag_n")))["right"]


def test_outside_the_catalogue_and_faults():
    jet = hidden("outside", ("x.jet", 1.0, []))
    assert score_case(jet, answer(verdict="unexplained"))["right"]
    partly = score_case(jet, answer(cause("air.wind[x]"), also_unexplained=True))
    assert (partly["right"], partly["wrong"]) == (True, True)
    assert not score_case(jet, answer(verdict="adequate"))["right"]
    jump = hidden("fault", fault="clock jump", right_for_fault=["obs.clock"])
    assert not score_case(jump, {"refused": "No space left on device"})["right"]
    assert score_case(jump, answer(verdict="invalid_data"))["right"]
    assert score_case(jump, answer(cause("obs.clock")))["right"]
    assert not score_case(jump, answer(cause("obs.clock"), cause("mass.hem")))["right"]
    assert not score_case(jump, {"failed": "Killed"})["right"]


def test_no_answer_is_never_right():
    for said in ({"refused": "no"}, {"failed": "no"}):
        found = score_case(hidden("null"), said)
        assert (found["right"], found["no_answer"]) == (False, True)


# -- rates -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"),
    [
        (0, 60, 0.0, 0.0596),
        (0, 30, 0.0, 0.1157),
        (17, 20, 0.6211, 0.9679),
        (20, 20, 0.8316, 1.0),
        (1, 10, 0.0025, 0.4450),
    ],
)
def test_bounds_are_those_of_published_tables(hits, of, low, high):
    """0 of n: 1 - 0.025^(1/n); the others from tables of Clopper and Pearson (1934)."""
    assert rates.Rate(hits, of).bounds == pytest.approx((low, high), abs=2e-4)
    assert rates.Rate(0, 0).bounds is None


def cases():
    """Three nulls, one alarm; singles at both sizes; a double; one beyond the catalogue."""
    found = [
        score_case(hidden("null"), answer(verdict="adequate")),
        score_case(hidden("hard null"), answer(verdict="adequate")),
        score_case(hidden("hard null"), answer(cause("mass.hem"))),
        score_case(DRAG, answer(cause("air.drag_n", 1.32))),
        score_case(hidden("single", ("air.drag_n", 0.6), kind="0.5"), answer(verdict="adequate")),
        score_case(hidden("double", ("air.drag_n", 1.2), ("mass.hem", 0.02)), answer(cause("mass.hem", 0.02))),
        score_case(hidden("outside", ("x.jet", 1.0, [])), answer(verdict="unexplained")),
    ]
    return [{"name": f"{k}", "seconds": 10.0 + k, "gain": None, "sealed": True} | c for k, c in enumerate(found)]


def test_marks_count_what_they_say():
    by_label = {m.label: m for m in rates.compute_targets(cases())}
    alarms = by_label["nulls with a named cause, or refused"]
    assert (alarms.value, alarms.reached) == (rates.Rate(1, 3), "missed")
    assert by_label["class identified, singles at typical size"].value == rates.Rate(1, 1)
    assert by_label["class identified, singles at half"].value == rates.Rate(0, 1)
    assert by_label["amplitude error, median"].number == pytest.approx(0.05)
    assert by_label["amplitude error, median"].reached == "aim"
    assert by_label["both of two effects"].reached == "missed"
    assert by_label["outside the catalogue: unexplained"].reached == "aim"
    assert by_label["next experiment resolves"].reached == ""
    assert by_label["gain over the oracle's, median"].number is None
    shares = dict(
        rates.compute_further_rates([c | {"gain": g} for c, g in zip(cases(), (1.0, 0.9, -0.2), strict=False)])
    )
    assert shares["gain over the oracle's, 10 % quantile"] == pytest.approx(0.02)
    assert shares["gain over the oracle's below zero"] == rates.Rate(1, 3)


def test_the_page_has_every_case_and_every_mark():
    text = to_markdown(cases())
    assert "| nulls with a named cause, or refused | ≤ 5 % | ≤ 2 % | 33 % | 1 %–91 % | 3 | missed |" in text
    assert text.count("\n| ") > 7 + 12 + 10
    assert "13 s a diagnosis (median; longest 16 s; 7 of 7 within 4 minutes;" in text
    assert text.endswith("7 cases, 7 of them sealed\n")
    assert "no case is finished" in to_markdown([])


def test_what_shows_is_asked_of_the_truths_engine():
    both = hidden("double", ("mass.hem", 0.02), ("damp.kv", 0.004), ("obs.clock", 0.02))
    sizes = [
        {"name": "mass.hem", "unexplained_displacement_rms_m": 1e-3, "unexplained_force_rms_n": 0.0},
        {"name": "damp.kv", "unexplained_displacement_rms_m": 1e-4, "unexplained_force_rms_n": 2e-3},
    ]
    assert observable_effects(both, sizes) == [True, False, True], "a clock moves no cloth and is seen"
    assert observable_effects(both, None) is None
    cases = [{**score_case(DRAG, answer()), "are_observable": known} for known in ([True], [False], None)]
    row = dict(rates.compute_further_rates(cases))["class identified, singles at typical size that show"]
    assert (row.hits, row.of) == (0, 1)


def test_axis_and_sign_are_counted_beside_what_is_right():
    """A lean along the other axis, or the other way, is the same class."""
    tilt = hidden("single", ("env.gravity_tilt", 0.01))
    tilt["effects"][0]["hypothesis"] = "env.gravity_tilt[x]"
    named = [("[x]", 0.011), ("[y]", 0.011), ("[x]", -0.011)]
    cases = [score_case(tilt, answer(cause(f"env.gravity_tilt{axis}", a))) for axis, a in named]
    assert all(c["right"] for c in cases)
    assert [c["directions_right"] for c in cases] == [[True], [False], [False]]
    assert score_case(tilt, answer(cause("mass.hem", confounded=["env.gravity_tilt"])))["directions_right"] == [None]
    row = dict(rates.compute_further_rates(cases))["named outright: axis and sign are right as well"]
    assert tuple(row) == (1, 3)


def test_singles_are_counted_by_effect():
    def case(name, kind, identified, observable, family="single"):
        hidden = ["what it needs", name]  # wind is hidden with the drag that makes it felt
        return {
            "family": family,
            "hidden": hidden,
            "expected": [name],
            "kind": kind,
            "identified": [identified],
            "are_observable": [observable],
        }

    cases = [case("hem", "0.5", True, True), case("hem", "0.5", False, False), case("hem", "1", True, True)]
    cases += [case("drag", "1.5", False, True), case("drag", "two", True, True, "double")]
    found = rates.by_effect(cases)
    assert list(found) == ["drag", "hem"]
    assert [tuple(rate) for rate in found["hem"]] == [(1, 2), (1, 1), (0, 0), (2, 2)]
    assert [tuple(rate) for rate in found["drag"]] == [(0, 0), (0, 0), (0, 1), (0, 1)]


def test_what_a_stopped_diagnosis_took_is_not_known():
    cases = [{"seconds": s, "sealed": True} for s in (100.0, None, 300.0)]
    assert describe_durations(cases).startswith("200 s a diagnosis (median; longest 300 s; 1 of 2 within 4 minutes")
    assert "3 cases" in describe_durations(cases)
    assert "is not known, 1 cases" in describe_durations(cases[1:2])
    assert describe_durations([]) == "no case is finished"
