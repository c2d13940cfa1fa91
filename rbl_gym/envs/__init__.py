"""Environments: measurements out, anchor commands in; they know no estimator."""
