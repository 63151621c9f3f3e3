import pytest

pytest.importorskip("pytorch_kinematics")
pytest.importorskip("open3d")
