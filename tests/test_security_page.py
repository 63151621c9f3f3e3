"""SECURITY.md names a test for each promise; the tests exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAMES = sorted(set(re.findall(r"`((?:tests/)?[\w/]*test_\w+\.py(?:::\w+)?)`", (ROOT / "SECURITY.md").read_text())))


def test_tests_are_named():
    assert len(NAMES) > 20


@pytest.mark.parametrize("name", NAMES)
def test_a_test_of_the_page_exists(name):
    file, _, function = name.removeprefix("tests/").partition("::")
    text = (ROOT / "tests" / file).read_text()
    assert not function or re.search(rf"^def {function}\(", text, re.MULTILINE)
