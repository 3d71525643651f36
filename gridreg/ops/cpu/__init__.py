"""Compiled versions of the operations for the CPU."""
