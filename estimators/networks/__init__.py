"""Estimators of planar networks: cycle consensus, orientations, frames."""
