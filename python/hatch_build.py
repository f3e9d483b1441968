"""Puts what cargo has built into the wheel: the extension module, and the program as a script."""

import os
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CargoOutput(BuildHookInterface):
    """Takes both from the folder in EDDY_BUILT; EDDY_PLATFORM is the platform tag of the wheel (`linux_x86_64`)."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        built = Path(os.environ["EDDY_BUILT"])
        build_data["force_include"][str(built / "lib_eddy.so")] = "eddy/_eddy.abi3.so"
        build_data["shared_scripts"][str(built / "eddy")] = "eddy"
        # The stable interface of CPython 3.10.
        build_data["tag"] = f"cp310-abi3-{os.environ['EDDY_PLATFORM']}"
        build_data["pure_python"] = False
