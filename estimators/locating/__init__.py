"""Static localization: one epoch of ranges or angles in, a pose out."""
