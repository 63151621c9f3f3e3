"""The code of docs/planning.md runs as it stands."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_example_of_the_page(monkeypatch):
    monkeypatch.chdir(ROOT)
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "planning.md").read_text(), flags=re.DOTALL)
    scope: dict = {}
    exec(compile(block, "docs/planning.md", "exec"), scope)
    found = scope["found"]
    assert found.after[0] < 0.7 * found.before[0]
    assert found.recording.joints["left"].q.shape[1] == 7
