"""The errors that Nisus raises, each with one line that a user can act on."""

LARGEST = 1e50
"""Beyond any physical quantity in any unit; its fourth power, which covariances multiply up to, is still a number."""


class NisusError(Exception):
    """Anything that Nisus refuses: the text names the value, the rule and the remedy."""


class ConfigError(NisusError):
    """A twin's YAML, or a command-line value, that breaks a rule."""


class SourceError(NisusError):
    """A data source that cannot be opened or read."""


class EstimatorError(NisusError):
    """An estimator that does not apply, or an option out of its range."""


class ModelError(NisusError):
    """A model whose declaration or functions disagree."""
