"""Model planar sensing networks: graphs, cycles, rigidity, bounds, files."""
