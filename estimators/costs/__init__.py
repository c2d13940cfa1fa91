"""Costs of measurements at a pose, and the Gauss-Newton loop that minimises them."""
