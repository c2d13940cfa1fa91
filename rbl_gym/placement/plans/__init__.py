"""Floor plans: drawings (DXF, GeoJSON) and pictures read to the tables of a building file."""
