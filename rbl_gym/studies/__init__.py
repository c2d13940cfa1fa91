"""Studies: what the commands compute, as functions that return data."""
