"""The table of what a batch costs."""

import pytest

from torchcloth.benchmarks import batches
from torchcloth.engine import execution


def test_every_case_has_a_row(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["batches", "--fast"])
    monkeypatch.setattr(batches, "SUBSTEPS_PER_RUN", 20)
    batches.main()
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()[2:]]
    assert len(rows) == 3 * 2 * 2  # cases, precisions, runs
    assert all(float(row[5]) > 0 for row in rows)


def test_the_engine_is_left_as_it_was():
    before = execution.MIN_FILLED_LANES

    def fail_in_between() -> None:
        with batches.min_filled_lanes(2.0):
            assert execution.MIN_FILLED_LANES == 2.0
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_in_between()
    assert before == execution.MIN_FILLED_LANES
