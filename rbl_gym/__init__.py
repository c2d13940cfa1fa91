"""rbl-gym: localization of rigid bodies by radio, as Gymnasium environments and estimators.

Importing it registers the environments' ids and nothing heavy.
"""

from pathlib import Path

__version__ = "0.1.0"

# In a checkout the estimators and wrappers stand beside the package, not inside it; this lets
# them be found from the checkout's root under any install mode. Never true in site-packages.
_root = Path(__file__).resolve().parent.parent
if (_root / "pyproject.toml").is_file() and (_root / "estimators").is_dir():
    __path__.append(str(_root))


def _register_environments() -> None:
    from gymnasium.envs.registration import register, registry

    entry_points = {
        "RBL/Tracking-v0": (
            "rbl_gym.envs.tracking:TrackingEnv",
            "rbl_gym.envs.tracking_vector:TrackingVectorEnv",
        ),
        "RBL/AnchorPlacement-v0": (
            "rbl_gym.envs.placement:AnchorPlacementEnv",
            "rbl_gym.envs.placement:AnchorPlacementVectorEnv",
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
            "rbl_gym.wrappers.tasks:AnchorSelectionEnv",
            "rbl_gym.wrappers.tasks:AnchorSelectionVectorEnv",
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
