"""`rbl_gym.geometry.bodies` by its short name: tag layouts of bodies."""

from rbl_gym.geometry.bodies import (
    centred,
    cube,
    doa2019,
    icassp2013,
    octahedron,
    perturb,
    plate,
    pyramid,
)

__all__ = ["centred", "cube", "doa2019", "icassp2013", "octahedron", "perturb", "plate", "pyramid"]
