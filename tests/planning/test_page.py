"""The code of docs/explanation/planning.md runs as it stands."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_example_of_the_page(monkeypatch):
    monkeypatch.chdir(ROOT)
    plan, pieces, learning = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "explanation" / "planning.md").read_text(), flags=re.DOTALL
    )
    learning = learning.replace("waypoints=4", "waypoints=2").replace("motions=300", "motions=3")
    scope: dict = {}
    exec(compile(plan, "docs/explanation/planning.md", "exec"), scope)
    result = scope["found"]
    assert result.after[0] < 0.7 * result.before[0]
    assert result.recording.joints["left"].q.shape[1] == 7
    exec(compile(pieces, "docs/explanation/planning.md", "exec"), dict(scope))
    exec(compile(learning, "docs/explanation/planning.md", "exec"), scope)
    assert len(scope["found"].history) == 4  # and the final policy's
