"""Radiance fields that gridreg ships: VM- and CP-TensoRF, and a coordinate MLP."""
