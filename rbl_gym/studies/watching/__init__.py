"""Frames of filters at work, as plain data: simulations, environments, recordings, policies."""
