"""Regularizers for grid radiance fields, attached from the outside."""
