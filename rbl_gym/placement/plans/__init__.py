"""Read floor plans: drawings (DXF, GeoJSON) and pictures become tables of a building file."""
