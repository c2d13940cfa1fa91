"""Geometry: rotations, tag layouts of bodies, regions for anchors, obstacles."""
