"""Compositions of regularizers: by name, and to plain data and back."""
