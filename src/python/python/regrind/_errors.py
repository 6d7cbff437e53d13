"""Exceptions of the package."""


class RegrindError(Exception):
    """Any refusal by Regrind: the text says where, which value, and what to do."""


class DataError(RegrindError):
    """Data or arguments that cannot be used."""


class RegistrationError(RegrindError):
    """Measured points that could not be registered."""


class ModelError(RegrindError):
    """Deviations of which no model of the form could be made."""


class ProgramError(RegrindError):
    """The program ``regrind`` could not be called, or ended with a fault."""
