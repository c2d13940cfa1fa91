"""Planar sensing networks: graphs, cycles, rigidity, bounds, files."""
