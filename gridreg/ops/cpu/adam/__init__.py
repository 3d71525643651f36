"""Adam for grids: one pass over parameters, moments and penalties."""
