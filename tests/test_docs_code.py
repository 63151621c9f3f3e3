"""Every Python block of the README and the documentation runs as it stands.

The blocks of one page run in order, in one namespace, in an empty folder. ``PREPARE`` puts there what the page's text
assumes: files of a reader, or names that an earlier sentence describes.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
PREPARE: dict[str, Callable[[Path], dict[str, Any]]] = {}


def read_blocks(page: Path) -> list[str]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", [page for page in PAGES if read_blocks(page)], ids=page_name)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    torch.set_default_dtype(torch.float32)  # as in a reader's session
    monkeypatch.chdir(tmp_path)
    namespace = PREPARE.get(page_name(page), lambda folder: {})(tmp_path)
    for number, block in enumerate(read_blocks(page), start=1):
        exec(compile(block, f"{page_name(page)}, block {number}", "exec"), namespace)
    torch.set_default_dtype(torch.float32)
