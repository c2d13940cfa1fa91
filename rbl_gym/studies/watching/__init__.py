"""Frames of running filters as plain data: simulations, environments, recordings, policies."""
