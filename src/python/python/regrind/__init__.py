"""Exact registration of measured probe centres to the offset of a nominal surface, with uncertainty.

Lengths are in millimetres and angles in radians. Every refusal is a :class:`RegrindError` that says where and why.
"""

from ._regrind import (
    DataError,
    Form,
    Interval,
    ModelError,
    Nominal,
    Registration,
    RegistrationError,
    RegrindError,
    __version__,
    model,
    read_points,
    register,
)

__all__ = [
    "DataError",
    "Form",
    "Interval",
    "ModelError",
    "Nominal",
    "Registration",
    "RegistrationError",
    "RegrindError",
    "__version__",
    "model",
    "read_points",
    "register",
]
