"""Model measurements: ranges with noise laws and links, angles of arrival, link biases."""
