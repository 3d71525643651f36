"""The laws that every regularizer keeps, for those who write one: `check_regularizer`."""

from gridreg.testing._laws import LAWS, accepted, check_regularizer
from gridreg.testing._mask_laws import check_mask
from gridreg.testing._subjects import Subject, examples_on

__all__ = ["LAWS", "Subject", "accepted", "check_mask", "check_regularizer", "examples_on"]
