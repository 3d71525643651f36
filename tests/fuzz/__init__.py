"""Damaged and hostile inputs: strategies that know the formats, and the judge of what becomes of them."""
