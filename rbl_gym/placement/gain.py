"""Another name of `rbl_gym.measurements.gain`."""

from rbl_gym.measurements.gain import EVERYWHERE as EVERYWHERE
from rbl_gym.measurements.gain import Gain as Gain
from rbl_gym.measurements.gain import share_and_slope as share_and_slope
