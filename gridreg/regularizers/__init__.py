"""The regularizers, and the plain functions that they are made of."""
