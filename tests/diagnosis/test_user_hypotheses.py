"""A user's causes are read from a file by the command, and again where a model that has them is loaded."""

import math
import re
import sys
from pathlib import Path

import pytest
import torch
from helpers import sheet_episodes

from torchcloth.cli import main
from torchcloth.diagnosis import Hypothesis, build_base_model, prepare_data, register_file
from torchcloth.diagnosis.causes import hypotheses, user_hypotheses
from torchcloth.errors import InvalidInput

FILE = """
from torchcloth import effects
from torchcloth.diagnosis import Hypothesis, register

register(Hypothesis("my.damping", "1/s", {typical}, lambda w, a: w.with_cloth({{"mine": effects.MassDamping(a)}})))
"""


@pytest.fixture
def file(tmp_path):
    yield tmp_path / "mine.py"
    hypotheses.unregister("my.damping")
    user_hypotheses._files.clear()


def test_a_file_registers_and_what_depends_on_it_knows_its_content(file):
    file.write_text(FILE.format(typical=2.0))
    (found,) = register_file(file)
    assert (found.name, found.typical) == ("my.damping", 2.0)
    assert "my.damping" in {h.name for h in hypotheses.list_known_hypotheses()}
    before = user_hypotheses.digest_user_files()
    file.write_text(FILE.format(typical=3.0))
    assert [h.typical for h in register_file(file)] == [3.0]
    assert user_hypotheses.digest_user_files() != before
    assert len(user_hypotheses.digest_user_files()) == 1


def test_what_the_file_imports_counts_as_well_and_it_may_be_run_again(file):
    """From beside it. What is registered again is the same object then; a search that goes on depends on its source."""
    helper = file.parent / "my_helper_of_causes.py"
    helper.write_text(FILE.format(typical=2.0).replace("register(", "CAUSE = ("))
    file.write_text(
        "from torchcloth.diagnosis import register\nfrom my_helper_of_causes import CAUSE\nregister(CAUSE)\n"
    )
    path = list(sys.path)
    first, before = register_file(file), user_hypotheses.digest_user_files()
    assert sys.path == path
    assert register_file(file) == first
    assert user_hypotheses.digest_user_files() == before
    helper.write_text(helper.read_text() + "# another law\n")
    register_file(file)
    assert user_hypotheses.digest_user_files() != before


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "got no file .*mine.py; expected a Python file that calls"),
        ("x = 1", "got .*mine.py, which registers nothing"),
        ("x = (", "got SyntaxError in .*mine.py, line 1"),
        ("x = 1\n1 / 0", "got ZeroDivisionError in .*mine.py, line 2: division by zero"),
        ("import sys\nsys.exit(3)", "got SystemExit in .*mine.py, line 2: 3"),
    ],
)
def test_what_is_no_file_of_causes_is_one_line(file, content, said, capsys):
    if content is not None:
        file.write_text(content)
    with pytest.raises(InvalidInput, match=said):
        register_file(file)
    assert main(["diagnose", "nowhere", "--out", str(file.parent / "out"), "--causes", str(file)]) == 2
    assert capsys.readouterr().err.startswith("torchcloth: causes; got ")


def test_what_a_hypothesis_lacks_is_said_once(file):
    file.write_text(FILE.format(typical=0.0))
    with pytest.raises(
        InvalidInput, match=r"^.*mine.py, line 5: typical of 'my.damping'; got 0.0; expected a value > 0"
    ):
        register_file(file)


def test_kin_may_be_a_list():
    """What was simulated is remembered by the causes of the world."""
    given = {"name": "my.damping", "unit": "1/s", "typical": 2.0, "apply": lambda world, _: world}
    listed, plain = (Hypothesis(**given, structurally_equivalent=kin) for kin in (["obs.clock"], ("obs.clock",)))
    assert hash(listed) == hash(plain)
    assert listed == plain


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "residual.weave"}, "as laws of a residual force are called"),
        ({"name": "air.drag_n"}, "which the catalogue has"),
        ({"typical": math.nan}, "typical of 'my.damping'; got nan"),
        ({"typical": math.inf}, "typical of 'my.damping'; got inf"),
        ({"smallest_fraction": 0.0}, "smallest_fraction of 'my.damping'; got 0"),
    ],
)
def test_causes_that_a_search_could_not_use_are_refused(change, said):
    given = {"name": "my.damping", "unit": "1/s", "typical": 2.0, "apply": lambda world, _: world} | change
    before = hypotheses.list_known_hypotheses()
    with pytest.raises(InvalidInput, match=said):
        hypotheses.register(Hypothesis(**given))
    assert hypotheses.list_known_hypotheses() == before


def test_the_example_of_the_docs_is_one(file):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "diagnose.md").read_text(encoding="utf-8")
    for text in re.findall(r"```py\n(.*?)```", page, re.DOTALL):
        compile(text, "docs/how-to/diagnose.md", "exec")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    file.write_text(example)
    (travel,) = register_file(file)
    hypotheses.unregister(travel.name)
    recording = sheet_episodes.make_episode()
    model = build_base_model(recording)
    (episode,) = prepare_data(model, [recording]).episodes
    before, after = (
        model.build_world([(travel, a)]).apply_motion(episode).motion["left"].pose[:, :3, 3] for a in (0.0, 0.1)
    )
    way = before - before[0]
    assert float(way.abs().max()) > 0.01
    torch.testing.assert_close(after - after[0], 1.1 * way)
