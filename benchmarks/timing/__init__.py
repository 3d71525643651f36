"""Costs of training and rendering: see docs/speed.md."""
