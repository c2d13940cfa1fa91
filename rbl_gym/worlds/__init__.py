"""Worlds: the scene, the named scenes, overrides, and the simulation of episodes."""
