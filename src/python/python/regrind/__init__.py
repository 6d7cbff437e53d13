"""Exact registration of measured probe centres to the offset of a nominal surface, with uncertainty.

Lengths are in millimetres and angles in radians. Every refusal is a :class:`RegrindError` that says where and why.
"""

from ._regrind import (
    DataError,
    ErrorMap,
    Form,
    Interval,
    Iso10110,
    ModelError,
    Nominal,
    PolynomialFit,
    Registration,
    RegistrationError,
    RegrindError,
    __version__,
    error_map,
    gaussian,
    iso10110,
    model,
    read_points,
    register,
    zernike_fit,
)

__all__ = [
    "DataError",
    "ErrorMap",
    "Form",
    "Interval",
    "Iso10110",
    "ModelError",
    "Nominal",
    "PolynomialFit",
    "Registration",
    "RegistrationError",
    "RegrindError",
    "__version__",
    "error_map",
    "gaussian",
    "iso10110",
    "model",
    "read_points",
    "register",
    "zernike_fit",
]
