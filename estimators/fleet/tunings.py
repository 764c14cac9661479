"""Values of a tuning by asset: arrays over the structure of one shared tuning, without a machine for each asset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..compiled.context import _FIELDS
from ..compiled.jacobians import constant_rows
from ..errors import ConfigError, EstimatorError, quoted
from ..fold_machine import Machine
from ..tuning import Tuning

GROUPS = {"Q": "q", "R": "r", "p": "p"}
"""Fields of a tuning whose values may differ from asset to asset, by the first part of their keys."""


class AssetTunings:
    """Tunings of assets that differ from a shared one in some values, and their contexts."""

    def __init__(self, machine: Machine, values: Mapping[str, ArrayLike], assets: Sequence[object]) -> None:
        """Check the values, and make a context for each asset.

        Args:
            machine: Machine of the shared tuning.
            values: Values (assets,) by key of the tuning (`Q.NAME`, `R.NAME`, `p.NAME`), in the units of `Tuning`;
                NaN is the shared value.
            assets: Names of the assets, for messages.

        Raises:
            EstimatorError: If a key is none of these, a shape does not fit, or a value is out of range.
        """
        self._machine, tuning, count = machine, machine.tuning, len(assets)
        self.columns = {group: np.tile(np.asarray(getattr(tuning, group), float), (count, 1)) for group in "qrp"}
        for key, given in values.items():
            self._set(key, given, assets)
        base = np.array([machine.context]).view(np.int64)
        self.contexts = np.tile(base, (count, 1))
        """Context of each asset, as its numbers, (assets, fields)."""
        for group, column in self.columns.items():
            self._point(group, column)
        self._held: list[object] = []
        self._point_to_derived()

    def _set(self, key: str, given: ArrayLike, assets: Sequence[object]) -> None:
        tuning, group = self._machine.tuning, GROUPS.get(key.partition(".")[0])
        column = np.asarray(given, float)
        if column.shape != (len(assets),):
            raise EstimatorError(f"fleet: {key} has shape {column.shape}; it must be ({len(assets)},), one per asset")
        try:
            known = tuning.get(key)
        except ConfigError as error:
            raise EstimatorError(f"fleet: {error}") from None
        if group is None or isinstance(known, (bool, str)):
            raise EstimatorError(
                f"fleet: {quoted(key)} is the same for all assets; those of Q, R and p may differ from asset to asset"
            )
        own = ~np.isnan(column)
        if not own.any():
            return
        if wrong := out_of_range(tuning, key, column):
            raise EstimatorError(f"fleet: asset {assets[wrong[0]]}: {wrong[1]}")
        self.columns[group][np.ix_(own, tuning.rows_of(key))] = column[own, None]

    def _point(self, name: str, column: np.ndarray) -> None:
        """Set a field of all contexts to the addresses of the rows of an array."""
        self.contexts[:, _FIELDS.index(name)] = column.ctypes.data + column.strides[0] * np.arange(len(column))

    def _point_to_derived(self) -> None:
        """Set the fields that follow from the values: constant Jacobians, and a gain for one R."""
        machine, model = self._machine, self._machine.model
        if model.linear and model.nu == 0:
            rows = [len(sensor.rows) for sensor in model.sensors]
            distinct, which = np.unique(self.columns["p"], axis=0, return_inverse=True)
            made = [constant_rows(machine.compiled.static, p, rows, model.nx) for p in distinct]
            self._held.append(made)
            places = np.array([(H.ctypes.data, mode.ctypes.data) for H, mode, _ in made])[which.ravel()]
            self.contexts[:, [_FIELDS.index("H"), _FIELDS.index("H_mode")]] = places
        if machine.estimator.fixed_r:
            tuned = [machine.estimator.tune(machine.options, model, self.tuning(k)) for k in range(len(self.contexts))]
            options = np.array(tuned, float).reshape(len(tuned), -1)
            self._held.append(options)
            self._point("options", options)

    def tuning(self, k: int) -> Tuning:
        """Return the tuning of asset k."""
        return replace(self._machine.tuning, **{group: column[k].copy() for group, column in self.columns.items()})


def out_of_range(tuning: Tuning, key: str, column: np.ndarray) -> tuple[int, str] | None:
    """Return the position of a value (assets,) that is out of range and the reason; None if all are in range or NaN."""
    # The extremes: where these are in range, so are the others.
    for k in (int(np.nanargmin(column)), int(np.nanargmax(column))) if not np.isnan(column).all() else ():
        try:
            tuning.set(key, float(column[k]))
        except ConfigError as error:
            return k, str(error)
    return None
