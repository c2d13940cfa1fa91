"""Measurements: ranges with their noise laws and links, angles of arrival, link biases."""
