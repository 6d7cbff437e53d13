"""Exact registration of measured probe centres to the offset of a nominal surface, with uncertainty.

Lengths are in millimetres and angles in radians. Every refusal is a :class:`RegrindError` that says where and why.
"""

import importlib

from ._errors import DataError, ModelError, ProgramError, RegistrationError, RegrindError
from ._program import Cycle, Run, Verification, simulate, verify
from ._regrind import (
    Correction,
    ErrorMap,
    Form,
    Interval,
    Iso10110,
    Nominal,
    PolynomialFit,
    Registration,
    ToolPath,
    __version__,
    compensate,
    error_map,
    gaussian,
    iso10110,
    model,
    read,
    register,
    toolpath,
    write,
    zernike_fit,
)



def __getattr__(name: str) -> object:
    """Imports ``regrind.plot`` and ``regrind.benchmark`` when they are first used."""
    if name in ("plot", "benchmark"):
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Correction",
    "Cycle",
    "DataError",
    "ErrorMap",
    "Form",
    "Interval",
    "Iso10110",
    "ModelError",
    "Nominal",
    "PolynomialFit",
    "ProgramError",
    "Registration",
    "RegistrationError",
    "RegrindError",
    "Run",
    "ToolPath",
    "Verification",
    "__version__",
    "compensate",
    "error_map",
    "gaussian",
    "iso10110",
    "model",
    "read",
    "register",
    "simulate",
    "toolpath",
    "verify",
    "write",
    "zernike_fit",
]
