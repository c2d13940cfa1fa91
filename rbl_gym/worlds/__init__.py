"""Worlds: scenes, named scenes, overrides, families, and the simulation of episodes."""
