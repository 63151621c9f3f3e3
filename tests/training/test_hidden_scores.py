"""How the hidden round is scored, on answers written by hand."""

import pytest

from torchcloth.training.studies import hidden_rates as rates
from torchcloth.training.studies.hidden_scores import judged, shows
from torchcloth.training.studies.hidden_tables import markdown, seconds


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


def cause(effect, amplitude=1.0, alike=(), rivals=(), ci95=None):
    return {
        "effect": effect, "amplitude": amplitude, "unit": "-", "class": sorted({effect, *alike}),
        "rivals": [{"effect": r, "amplitude": 1.0, "unit": "-"} for r in rivals],
        "ci95": list(ci95 or (amplitude - 0.1, amplitude + 0.1)),
    }  # fmt: skip


def answer(*causes, verdict="identified", **more):
    return {"verdict": verdict, "causes": list(causes), "unresolvable": [], "undecided": []} | more


DRAG = hidden("single", ("air.drag_n", 1.2))


def test_a_null_is_right_when_nothing_is_named():
    assert judged(hidden("null"), answer(verdict="adequate"))["right"]
    assert judged(hidden("null"), answer(verdict="unexplained"))["right"]
    assert not judged(hidden("hard null"), answer(verdict="invalid_data"))["right"], "sound episodes are refused"
    alarm = judged(hidden("null"), answer(cause("air.linear")))
    assert not alarm["right"]
    assert alarm["named"] == ["air.linear"]
    # what is there, but too small to matter, is no cause either
    assert not judged(hidden("hard null", ("air.linear", 0.2)), answer(cause("air.linear")))["right"]


def test_a_single_is_found_by_name_or_class_and_covered_by_rivals():
    by_name = judged(DRAG, answer(cause("air.drag_n", 1.26, ci95=(1.1, 1.3))))
    assert by_name["right"]
    assert by_name["amplitudes"] == [{"error": pytest.approx(0.05), "inside": True}]
    by_class = judged(DRAG, answer(cause("air.linear", alike=["air.drag_n"])))
    assert (by_class["right"], by_class["covered"], by_class["wrong"]) == (True, [True], False)
    by_rival = judged(DRAG, answer(cause("air.linear", rivals=["air.drag_n"]), verdict="ambiguous"))
    assert (by_rival["right"], by_rival["covered"], by_rival["wrong"]) == (False, [True], False)
    assert by_rival["sizes"] == [2]
    assert by_rival["amplitudes"] == [None]


def test_one_cause_is_not_both_of_two_effects():
    both = hidden("double", ("air.drag_n", 1.2), ("air.linear", 2.0), kind="two")
    vague = judged(both, answer(cause("air.drag_n", 1.2, alike=["air.linear", "damp.bend"])))
    assert (vague["found"], vague["right"]) == ([True, False], False)
    told = judged(both, answer(cause("air.linear", 2.0, alike=["air.drag_n"]), cause("air.drag_n", 1.2)))
    assert (told["found"], told["right"]) == ([True, True], True)
    assert [a["error"] for a in told["amplitudes"]] == pytest.approx([0.0, 0.0])


def test_the_order_of_an_answer_does_not_matter():
    """Damping could stand for both effects, the hem for drag alone: listed first, damping was taken for drag."""
    two = hidden("double", ("air.drag_n", 1.0), ("air.linear", 1.0))
    causes = [cause("damp.bend", alike=["air.drag_n", "air.linear"]), cause("mass.hem", alike=["air.drag_n"])]
    for listed in (causes, causes[::-1]):
        found = judged(two, answer(*listed))
        assert (found["found"], found["right"]) == ([True, True], True)
    named = [cause("air.linear", alike=["air.drag_n"]), cause("air.drag_n", alike=["air.linear"])]
    assert judged(two, answer(*named))["amplitudes"] == [{"error": 0.0, "inside": True}] * 2


def test_an_axis_is_no_other_name_and_counts_once():
    tilt = hidden("single", ("env.gravity_tilt", 0.01))
    found = judged(tilt, answer(cause("env.gravity_tilt[x]", 0.011, alike=["env.gravity_tilt[y]"])))
    assert (found["right"], found["sizes"], found["wrong"]) == (True, [1], False)


def test_alone_and_false_is_confident_and_wrong_even_beside_what_is_right():
    wrong = judged(DRAG, answer(cause("mass.hem")))
    assert (wrong["right"], wrong["wrong"], wrong["spurious"], wrong["covered"]) == (False, True, 1, [False])
    both = judged(DRAG, answer(cause("air.drag_n", 1.2), cause("mass.hem")))
    assert (both["right"], both["wrong"], both["spurious"]) == (True, True, 1)
    unsure = judged(DRAG, answer(cause("mass.hem", rivals=["mass.seam"])))
    assert (unsure["wrong"], unsure["spurious"]) == (False, 1)


def test_what_a_wind_needs_is_no_false_cause():
    wind = hidden("single", ("air.wind", 0.3))
    wind["effects"].insert(0, hidden("", ("air.drag_n", 1.2))["effects"][0] | {"is_enabling": True})
    found = judged(wind, answer(cause("air.wind[x]", 0.3), cause("air.drag_n", 1.2)))
    assert (found["right"], found["wrong"], found["spurious"]) == (True, False, 0)
    only = judged(wind, answer(cause("air.drag_n", 1.2)))
    assert (only["right"], only["wrong"]) == (False, False)


def test_signs_are_the_librarys():
    late = hidden("single", ("obs.clock", 0.03))
    late["effects"][0]["sign"] = -1.0
    off = judged(late, answer(cause("obs.clock", -0.033, ci95=(-0.036, -0.031))))["amplitudes"]
    assert off == [{"error": pytest.approx(0.1), "inside": False}]
    late["effects"][0]["sign"] = 0.0
    assert judged(late, answer(cause("obs.clock", 0.5)))["amplitudes"] == [None]


def test_both_of_two():
    pair = hidden("double", ("air.drag_n", 1.2), ("mass.hem", 0.02))
    assert judged(pair, answer(cause("mass.hem", 0.02), cause("air.drag_n", 1.2)))["right"]
    one = judged(pair, answer(cause("mass.hem", 0.02)))
    assert (one["right"], one["found"]) == (False, [False, True])


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
    assert judged(hidden("confounded", ("env.gravity_tilt", 0.01), **LIKE), said)["right"] is right


def test_where_the_data_might_tell_its_name_alone_is_right():
    soft = hidden(
        "confounded", ("air.linear", 1.0), confounded={"causes": ["air.linear", "air.drag_n"], "may_be_separable": True}
    )
    assert judged(soft, answer(cause("air.linear")))["right"]
    assert not judged(soft, answer(cause("air.drag_n")))["right"]


def test_outside_the_catalogue_and_faults():
    jet = hidden("outside", ("x.jet", 1.0, []))
    assert judged(jet, answer(verdict="unexplained"))["right"]
    partly = judged(jet, answer(cause("air.wind[x]"), also_unexplained=True))
    assert (partly["right"], partly["wrong"]) == (True, True)
    assert not judged(jet, answer(verdict="adequate"))["right"]
    jump = hidden("fault", fault="clock jump", right_for_fault=["obs.clock"])
    assert not judged(jump, {"refused": "No space left on device"})["right"]
    assert judged(jump, answer(verdict="invalid_data"))["right"]
    assert judged(jump, answer(cause("obs.clock")))["right"]
    assert not judged(jump, answer(cause("obs.clock"), cause("mass.hem")))["right"]
    assert not judged(jump, {"failed": "Killed"})["right"]


def test_no_answer_is_never_right():
    for said in ({"refused": "no"}, {"failed": "no"}):
        found = judged(hidden("null"), said)
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
        judged(hidden("null"), answer(verdict="adequate")),
        judged(hidden("hard null"), answer(verdict="adequate")),
        judged(hidden("hard null"), answer(cause("mass.hem"))),
        judged(DRAG, answer(cause("air.drag_n", 1.32))),
        judged(hidden("single", ("air.drag_n", 0.6), kind="0.5"), answer(verdict="adequate")),
        judged(hidden("double", ("air.drag_n", 1.2), ("mass.hem", 0.02)), answer(cause("mass.hem", 0.02))),
        judged(hidden("outside", ("x.jet", 1.0, [])), answer(verdict="unexplained")),
    ]
    return [{"name": f"{k}", "seconds": 10.0 + k, "gain": None, "sealed": True} | c for k, c in enumerate(found)]


def test_marks_count_what_they_say():
    by_label = {m.label: m for m in rates.marks(cases())}
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
    shares = dict(rates.further([c | {"gain": g} for c, g in zip(cases(), (1.0, 0.9, -0.2), strict=False)]))
    assert shares["gain over the oracle's, 10 % quantile"] == pytest.approx(0.02)
    assert shares["gain over the oracle's below zero"] == rates.Rate(1, 3)


def test_the_page_has_every_case_and_every_mark():
    text = markdown(cases())
    assert "| nulls with a named cause, or refused | ≤ 5 % | ≤ 2 % | 33 % | 1 %–91 % | 3 | missed |" in text
    assert text.count("\n| ") > 7 + 12 + 10
    assert "13 s a diagnosis (median; longest 16 s; 7 of 7 within 4 minutes;" in text
    assert text.endswith("7 cases, 7 of them sealed\n")
    assert "no case is finished" in markdown([])


def test_what_shows_is_asked_of_the_truths_engine():
    both = hidden("double", ("mass.hem", 0.02), ("damp.kv", 0.004), ("obs.clock", 0.02))
    sizes = [
        {"name": "mass.hem", "unexplained_displacement_rms_m": 1e-3, "unexplained_force_rms_n": 0.0},
        {"name": "damp.kv", "unexplained_displacement_rms_m": 1e-4, "unexplained_force_rms_n": 2e-3},
    ]
    assert shows(both, sizes) == [True, False, True], "a clock moves no cloth and is seen"
    assert shows(both, None) is None
    cases = [{**judged(DRAG, answer()), "shows": known} for known in ([True], [False], None)]
    row = dict(rates.further(cases))["class identified, singles at typical size that show"]
    assert (row.hits, row.of) == (0, 1)


def test_axis_and_sign_are_counted_beside_what_is_right():
    """A lean along the other axis, or the other way, is the same class."""
    tilt = hidden("single", ("env.gravity_tilt", 0.01))
    tilt["effects"][0]["hypothesis"] = "env.gravity_tilt[x]"
    named = [("[x]", 0.011), ("[y]", 0.011), ("[x]", -0.011)]
    cases = [judged(tilt, answer(cause(f"env.gravity_tilt{axis}", a))) for axis, a in named]
    assert all(c["right"] for c in cases)
    assert [c["ways"] for c in cases] == [[True], [False], [False]]
    assert judged(tilt, answer(cause("mass.hem", alike=["env.gravity_tilt"])))["ways"] == [None]
    row = dict(rates.further(cases))["named outright: axis and sign are right as well"]
    assert tuple(row) == (1, 3)


def test_singles_are_counted_by_effect():
    def case(name, kind, found, shows, family="single"):
        hidden = ["what it needs", name]  # wind is hidden with the drag that makes it felt
        return {"family": family, "hidden": hidden, "sought": [name], "kind": kind, "found": [found], "shows": [shows]}

    cases = [case("hem", "0.5", True, True), case("hem", "0.5", False, False), case("hem", "1", True, True)]
    cases += [case("drag", "1.5", False, True), case("drag", "two", True, True, "double")]
    found = rates.by_effect(cases)
    assert list(found) == ["drag", "hem"]
    assert [tuple(rate) for rate in found["hem"]] == [(1, 2), (1, 1), (0, 0), (2, 2)]
    assert [tuple(rate) for rate in found["drag"]] == [(0, 0), (0, 0), (0, 1), (0, 1)]


def test_what_a_stopped_diagnosis_took_is_not_known():
    cases = [{"seconds": s, "sealed": True} for s in (100.0, None, 300.0)]
    assert seconds(cases).startswith("200 s a diagnosis (median; longest 300 s; 1 of 2 within 4 minutes")
    assert "3 cases" in seconds(cases)
    assert "is not known, 1 cases" in seconds(cases[1:2])
    assert seconds([]) == "no case is finished"
