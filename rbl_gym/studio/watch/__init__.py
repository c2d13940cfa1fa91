"""Filters at work: frames as plain data, and the page on which they are watched."""
