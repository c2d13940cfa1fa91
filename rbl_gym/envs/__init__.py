"""Environments: they produce measurements and take anchor commands, without any estimator."""
