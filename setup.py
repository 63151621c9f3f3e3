"""What pyproject.toml cannot say: the engine is built at installation where there is a compiler.

It lands in the package (``torchcloth/engine/built``), under a name that holds for this processor alone; elsewhere it is
not taken, and built at first use. An editable installation builds into the user's cache. TORCHCLOTH_PREBUILD=0 leaves
it out.
"""

import importlib.util
import os
import shutil
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ENGINE = Path(__file__).parent / "torchcloth" / "engine"


class BuildWithEngine(build_py):
    """The library is a convenience: without it the installation is still whole."""

    def run(self):
        """Copy the Python files, then build."""
        super().run()
        if os.environ.get("TORCHCLOTH_PREBUILD") == "0":
            return
        spec = importlib.util.spec_from_file_location("building", ENGINE / "building.py")
        building = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(building)
        try:
            library = building.cached() or building.build()
            if not self.editable_mode:
                folder = Path(self.build_lib, "torchcloth", "engine", "built")
                folder.mkdir(parents=True, exist_ok=True)
                part = folder / f".{library.name}"  # a process that loads half a library dies
                shutil.copyfile(library, part)
                os.replace(part, folder / library.name)
        except (building.Unbuilt, OSError) as miss:
            print(f"torchcloth: the engine is not built now: {miss}", file=sys.stderr)


setup(cmdclass={"build_py": BuildWithEngine})
