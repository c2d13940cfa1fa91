"""Constants of losses and robust updates, for the kernels and their textbook forms."""

# Indices of the five numbers of a loss, see `estimators/costs/losses.py`.
THRESHOLD, CUTOFF, SCALE, POWER, OF_LATE = range(5)

# Whitened residual at which Huber's loss changes from squares to absolute values.
HUBER = 1.5
# Number of standard deviations beyond which a link contradicts a pose.
GATE = 4.0
# Gates after a wrong gate at the prior. The first one is wide, because Huber's pose is biased.
CUTOFFS = (6.0, GATE)
# If more than this share of the links contradicts a pose, the pose is in doubt and all links count.
LARGEST_SHARE_OUT = 0.5
# Whitened residual above which a possibly late range is weighted less, and the remaining share of
# its weight if it is late. Chosen on several public logs, whose errors hardly change from 0.8 to 1.
LATE_HUBER, LATE_SHARE = 1.0, 0.5
# Above this trace of the prior covariance of the rotation (rad^2), one linearisation may not do.
VAGUE = 0.25
