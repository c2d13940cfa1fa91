"""rbl-gym: localization of rigid bodies by radio, as Gymnasium environments and estimators.

Importing it registers the ids of the environments and loads no large modules.
"""

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import Any

__version__ = "0.2.0"

_ROOT = Path(__file__).resolve().parent.parent


class _Folders:
    """Find the two packages that are next to this one in a checkout."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        package, _, folder = name.partition(".")
        if package != __name__ or folder not in ("estimators", "wrappers"):
            return None
        place = _ROOT / folder
        return spec_from_file_location(
            name, place / "__init__.py", submodule_search_locations=[str(place)]
        )


# Not in site-packages, where both are inside this package. First in the list, before the finder of
# an editable install, which may belong to another checkout.
if (_ROOT / "pyproject.toml").is_file() and (_ROOT / "estimators").is_dir():
    sys.meta_path.insert(0, _Folders)


# Modules that were moved from the top level into packages: `from rbl_gym import scenes` works.
_MOVED = {
    "bearing": "measurements",
    "g2o": "networks",
    "layouts": "placement",
    "link_bias": "measurements",
    "obstacles": "geometry",
    "regions": "geometry",
    "rigidity": "networks",
    "rotations": "geometry",
    "scene_bounds": "worlds",
    "scene_files": "placement",
    "scenes": "worlds",
    "simulation": "worlds",
    "unknown_twist": "motion",
}


def __getattr__(name: str) -> Any:
    if name in _MOVED:
        return import_module(f"rbl_gym.{_MOVED[name]}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _register_environments() -> None:
    from gymnasium.envs.registration import register, registry

    entry_points = {
        "RBL/Tracking-v0": (
            "rbl_gym.envs.tracking:TrackingEnv",
            "rbl_gym.envs.tracking_vector:TrackingVectorEnv",
        ),
        "RBL/AnchorPlacement-v0": (
            "rbl_gym.wrappers.filter_reward:anchor_placement",
            "rbl_gym.wrappers.filter_reward:anchor_placement_vector",
        ),
        "RBL/PlanarNetwork-v0": (
            "rbl_gym.envs.network:PlanarNetworkEnv",
            "rbl_gym.envs.network:PlanarNetworkVectorEnv",
        ),
        "RBL/MobileAnchors-v0": (
            "rbl_gym.wrappers.tasks:MobileAnchorsEnv",
            "rbl_gym.wrappers.tasks:MobileAnchorsVectorEnv",
        ),
        "RBL/AnchorSelection-v0": (
            "rbl_gym.wrappers.selection:AnchorSelectionEnv",
            "rbl_gym.wrappers.selection:AnchorSelectionVectorEnv",
        ),
        "RBL/SharedAnchors-v0": (
            "rbl_gym.wrappers.shared_anchors:SharedAnchorsEnv",
            "rbl_gym.wrappers.shared_anchors:SharedAnchorsVectorEnv",
        ),
        "RBL/BaseStation-v0": (
            "rbl_gym.envs.base_station:BaseStationEnv",
            "rbl_gym.envs.base_station:BaseStationVectorEnv",
        ),
    }
    for env_id, (scalar, vector) in entry_points.items():
        if env_id not in registry:
            register(id=env_id, entry_point=scalar, vector_entry_point=vector)


_register_environments()
