"""Attach regularizers to a field from the outside, and take them off again."""
