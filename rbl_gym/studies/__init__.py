"""Studies: the computations of the commands, as functions that return data."""
