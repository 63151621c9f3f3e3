"""What pyproject.toml cannot say: the engine is built at installation where there is a compiler.

It lands in the package (``torchcloth/engine/built``), under a name that holds for this processor alone; elsewhere it is
not taken, and built at first use. An editable installation builds into the user's cache.

The environment variable TORCHCLOTH_PREBUILD changes this. ``0`` leaves the engine out. ``portable`` builds libraries
that run on other machines of this kind, for a wheel that is handed on (``make wheel``), and fails without a compiler.
"""

import importlib.util
import os
import shutil
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ENGINE = Path(__file__).parent / "torchcloth" / "engine"
PREBUILD = os.environ.get("TORCHCLOTH_PREBUILD")


class BuildWithEngine(build_py):
    """The native library is a convenience: without it the installation is still whole."""

    def run(self):
        """Copy the Python files, then build."""
        super().run()
        if PREBUILD == "0":
            return
        spec = importlib.util.spec_from_file_location("building", ENGINE / "building.py")
        building = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(building)
        folder = Path(self.build_lib, "torchcloth", "engine", "built")
        try:
            if PREBUILD == "portable":
                libraries = [building.build(level) for level in building.portable_levels()]
            else:
                libraries = [building.cached() or building.build()]
            if not self.editable_mode:
                folder.mkdir(parents=True, exist_ok=True)
            for library in [] if self.editable_mode else libraries:
                part = folder / f".{library.name}"  # a process that loads half a library dies
                shutil.copyfile(library, part)
                os.replace(part, folder / library.name)
        except (building.EngineUnavailable, OSError) as miss:
            if PREBUILD == "portable":
                raise
            print(f"torchcloth: the engine is not built now: {miss}", file=sys.stderr)


class DistributionWithEngine(Distribution):
    """Portable libraries count as compiled modules, so that the wheel is for one platform."""

    def has_ext_modules(self):
        """Return whether there are compiled modules."""
        return PREBUILD == "portable" or super().has_ext_modules()


class WheelForEveryPython(bdist_wheel):
    """The libraries know nothing of Python: one wheel serves all versions of Python 3 on a platform."""

    def get_tag(self):
        """Return the tag, e.g. py3-none-linux_x86_64."""
        python, abi, platform = super().get_tag()
        return ("py3", "none", platform) if PREBUILD == "portable" else (python, abi, platform)


setup(distclass=DistributionWithEngine, cmdclass={"build_py": BuildWithEngine, "bdist_wheel": WheelForEveryPython})
