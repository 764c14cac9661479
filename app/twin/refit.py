"""What a twin's YAML says of dual estimation, checked against its model."""

from __future__ import annotations

from config.loader import Loaded
from estimators.errors import ConfigError
from estimators.fit.entries import check_key
from estimators.tuning import Tuning


def check_refit(loaded: Loaded, estimator: str, tuning: Tuning) -> None:
    """Refuse entries that cannot be fitted beside the running twin.

    Raises:
        ConfigError: With file and line.
    """
    section = loaded.config.refit
    if section is None:
        return
    if tuning.model.black_box:
        raise loaded.error(("refit",), f"{tuning.model.name} is a black box, too slow for it; use nisus tune --windows")
    for name in section.entries:
        group, _, rest = name.partition(".")
        if group == "prior":
            raise loaded.error(("refit", "entries"), f"names {name}; a window begins where the filter is, not there")
        if group == "p" and rest in loaded.config.estimate:
            raise loaded.error(
                ("refit", "entries"),
                f"names {name}, which `estimate` moves into the state; keep it in one of them",
            )
        try:
            check_key(estimator, tuning, name)
        except ConfigError as error:
            raise loaded.error(("refit", "entries"), f"names {name}: {error}") from None
