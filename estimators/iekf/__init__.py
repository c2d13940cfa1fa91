"""Iterated extended Kalman filters of the pose, and their further states."""
