"""An instance of an FMU for model exchange (FMI 2 and 3), which computes the members of a block in turn.

The continuous states are set for each member, and a step of the classical Runge-Kutta method of fourth order gives the
next ones. The time of the FMU stays at 0 and no step of it is ever completed (completedIntegratorStep): to the FMU each
member is a trial state.

If it has event indicators, its events are handled at the beginning and the end of each step; where it can restore its
state (canGetAndSetFMUstate), discrete states start anew with each member, as they are no states of the filter.

Source: FMI 2.0.4 and FMI 3.0.1, sections Model Exchange.
"""

from __future__ import annotations

import ctypes
import os
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from config.yaml_files import shown_path
from estimators.errors import ModelError
from sources.worker_process import gist

if TYPE_CHECKING:
    from fmpy.fmi2 import FMU2Model
    from fmpy.fmi3 import FMU3Model
    from fmpy.model_description import ModelDescription

FATAL = 4
"""Status of a call after which no instance of the FMU may be used."""


class Fmu:
    """One instance of an FMU for model exchange, whose continuous states are set for each member of a block.

    Args:
        path: The FMU.
        description: Its description, as FMPy reads it.
        nx: Number of continuous states.
        inputs: Value references of the inputs.
        parameters: Value references of the parameters.

    Raises:
        ModelError: If it cannot be loaded.
    """

    def __init__(
        self, path: Path, description: ModelDescription, nx: int, inputs: Sequence[int], parameters: Sequence[int]
    ) -> None:
        self._name, self._two = shown_path(path), description.fmiVersion.startswith("2.")
        self._inputs, self._parameters = list(inputs), list(parameters)
        self._indicators = description.numberOfEventIndicators or len(description.eventIndicators)
        self._restores = bool(description.modelExchange.canGetAndSetFMUstate)
        self._lock = threading.Lock()
        self._x, self._rate = np.empty(nx), np.empty(nx)
        number = ctypes.POINTER(ctypes.c_double)
        self._x_at, self._rate_at = (array.ctypes.data_as(number) for array in (self._x, self._rate))
        self._kept: object = None
        self._ready: tuple[bytes, bytes] | None = None
        with self._blamed("cannot be loaded", "export it for this machine"):
            self._fmu = self._load(path, description)
        # Not at the end of the process, where another thread may still be in a call.
        weakref.finalize(self, _free, self._fmu, self._folder).atexit = False
        self._get, self._set = (
            (self._fmu.getReal, self._fmu.setReal) if self._two else (self._fmu.getFloat64, self._fmu.setFloat64)
        )
        self._derivatives = self._fmu.getDerivatives if self._two else self._fmu.getContinuousStateDerivatives
        self._update = self._fmu.newDiscreteStates if self._two else self._fmu.updateDiscreteStates
        with self._blamed("cannot be initialised"):
            self._initialise()
            self.default_u, self.default_p = self._get(self._inputs), self._get(self._parameters)

    def _load(self, path: Path, description: ModelDescription) -> FMU2Model | FMU3Model:
        import fmpy
        from fmpy.fmi2 import FMU2Model, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE
        from fmpy.fmi2 import defaultCallbacks as defaults
        from fmpy.fmi3 import FMU3Model

        # Removed with the instance.
        self._folder = tempfile.TemporaryDirectory(prefix="nisus-fmu-")
        here = os.getcwd()
        try:
            fmpy.extract(str(path), self._folder.name)
            platforms = sorted(item.name for item in Path(self._folder.name, "binaries").glob("*"))
            own = fmpy.platform if self._two else fmpy.platform_tuple
            if own not in platforms:
                has = f"it has {', '.join(platforms)}" if platforms else "it has none"
                raise ModelError(f"{self._name}: it has no binary for {own} ({has}); export it for this platform")
            fmu = (FMU2Model if self._two else FMU3Model)(
                guid=description.guid if hasattr(description, "guid") else description.instantiationToken,
                modelIdentifier=description.modelExchange.modelIdentifier,
                unzipDirectory=self._folder.name,
                instanceName="nisus",
            )
            if self._two:
                silent = fmi2CallbackLoggerTYPE(lambda *_: None)
                self._callbacks = fmi2CallbackFunctions(silent, defaults.allocateMemory, defaults.freeMemory)
                fmu.instantiate(callbacks=self._callbacks)
            else:
                fmu.instantiate(logMessage=lambda *_: None)
        finally:
            os.chdir(here)  # FMPy leaves the folder of a library that fails to load as the working directory.
        return fmu

    @contextmanager
    def _blamed(self, what: str, remedy: str = "correct its start values") -> Iterator[None]:
        """Name the FMU in errors of its calls."""
        try:
            yield
        except ModelError:
            raise
        except Exception as error:  # noqa: BLE001  FMPy raises bare exceptions
            raise ModelError(f"{self._name}: it {what}: {gist(error)}; {remedy}") from None

    def start(self) -> np.ndarray:
        """Return the states (nx,) after initialisation, and check what a filter needs.

        Raises:
            ModelError: If states cannot be set, derivatives are not finite or depend on time, or steps from one state
                differ.
        """
        u, p = np.array(self.default_u), np.array(self.default_p)
        with self._lock, self._blamed("fails at its start values"):
            self._prepare(u, p)
            start = self._present().copy()
            moved = start + 0.01 * (1.0 + np.abs(start))
            self._place(moved, u)
            if not np.array_equal(self._present(), moved) and not self._indicators:
                raise ModelError(f"{self._name}: setContinuousStates has no effect; a filter must set its states")
            now = self._rates_at(start)
            if not np.all(np.isfinite(now)):
                raise ModelError(f"{self._name}: its derivatives at the start values are not finite; correct those")
        first = self.advance(np.array([start, moved]), u, p, 1e-3)
        again = self.advance(np.array([moved, start]), u, p, 1e-3)
        if not np.array_equal(first, again[::-1], equal_nan=True):
            remedy = "it keeps more than its continuous states; export one that does not"
            flag = "" if self._restores else " and lacks canGetAndSetFMUstate, which would restore it"
            raise ModelError(f"{self._name}: steps from one state differ{flag}; {remedy}")
        with self._lock, self._blamed("fails at its start values"):
            self._prepare(u, p)
            for later in (1.0, 1000.0):
                self._fmu.setTime(later)
                if not np.array_equal(self._rates_at(start), now):
                    raise ModelError(
                        f"{self._name}: its derivatives depend on time, which a filter does not give; make the "
                        "quantity that changes an input"
                    )
            self._ready = None
        return start

    def advance(self, X: np.ndarray, u: np.ndarray, p: np.ndarray, dt: float) -> np.ndarray:
        """Return the states (N, nx) after dt seconds; NaN for those at which the FMU fails."""
        n = X.shape[1]
        with self._lock:
            if self._indicators:
                return self._rows(X, u, p, n, lambda: self._through_events(dt))
            return _rk4(lambda at: self._rows(at, u, p, n, self._rates), X, dt)

    def measured(self, references: list[int]) -> Callable[..., np.ndarray]:
        """Return h(X, u, p) of the variables with these value references: the measurements (N, ny)."""

        def h(X: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
            with self._lock:
                return self._rows(X, u, p, len(references), lambda: self._get(references))

        return h

    def _rows(self, X: np.ndarray, u: np.ndarray, p: np.ndarray, columns: int, values: Callable) -> np.ndarray:
        """Return what `values` gives at each state (N, columns); NaN where the FMU fails.

        Raises:
            ModelError: If it fails at all of them, or for good.
        """
        from fmpy.fmi1 import FMICallException

        out = np.full((len(X), columns), np.nan)
        known = np.flatnonzero(np.isfinite(X).all(axis=1))
        failed = 0
        for k in known:
            try:
                self._prepare(u, p)
                self._place(X[k], u)
                out[k] = values()
            except FMICallException as error:
                self._ready = None  # After an error only a reset is allowed.
                failed += 1
                if error.status == FATAL or failed == known.size:
                    raise ModelError(f"{self._name}: {error}") from None
            except ModelError:
                self._ready = None
                raise
        return out

    def _prepare(self, u: np.ndarray, p: np.ndarray) -> None:
        """Initialise the instance with these inputs and parameters, unless it is."""
        if self._ready is not None and p.tobytes() == self._ready[1]:
            if u.tobytes() != self._ready[0]:
                self._set(self._inputs, u.tolist())
                self._ready = (u.tobytes(), self._ready[1])
            return
        self._ready = None
        if self._kept is not None:
            self._fmu.freeFMUState(self._kept)
            self._kept = None
        self._fmu.reset()
        if self._parameters:
            self._set(self._parameters, p.tolist())
        if self._inputs:
            self._set(self._inputs, u.tolist())
        self._initialise()
        if self._indicators and self._restores:
            self._kept = self._fmu.getFMUState()
        self._ready = (u.tobytes(), p.tobytes())

    def _initialise(self) -> None:
        if self._two:
            self._fmu.setupExperiment(startTime=0.0)
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        self._settle()

    def _settle(self) -> None:
        """Iterate the discrete states in event mode, and return to continuous time."""
        for _ in range(100):
            again, ends, _, _, timed, _ = self._update()
            if ends:
                raise ModelError(
                    f"{self._name}: it ends the simulation (terminateSimulation); correct its start values"
                )
            if timed:
                raise ModelError(
                    f"{self._name}: it plans an event by time (nextEventTimeDefined), which a filter does not give; "
                    "make the quantity that changes an input"
                )
            if not again:
                break
        else:
            raise ModelError(f"{self._name}: its discrete states do not settle in 100 updates; correct the model")
        self._fmu.enterContinuousTimeMode()

    def _place(self, x: np.ndarray, u: np.ndarray) -> None:
        """Set the continuous states; if there are events, from the same discrete states each time, and handle them."""
        if self._kept is not None:
            self._fmu.setFMUState(self._kept)
            if self._inputs:
                self._set(self._inputs, u.tolist())
        self._put(x)
        if self._indicators:
            self._fmu.enterEventMode()
            self._settle()

    def _put(self, x: np.ndarray) -> None:
        self._x[:] = x
        self._fmu.setContinuousStates(self._x_at, self._x.size)

    def _present(self) -> np.ndarray:
        self._fmu.getContinuousStates(self._x_at, self._x.size)
        return self._x

    def _rates(self) -> np.ndarray:
        self._derivatives(self._rate_at, self._rate.size)
        return self._rate

    def _rates_at(self, x: np.ndarray) -> np.ndarray:
        """Return the rates at a state in the present mode, without events."""
        self._put(x)
        return self._rates().copy()

    def _through_events(self, dt: float) -> np.ndarray:
        """Step from where the instance is, with the relations of its mode, and handle the events at the end."""
        self._put(_rk4(self._rates_at, self._present().copy(), dt))
        self._fmu.enterEventMode()
        self._settle()
        return self._present()


def _free(fmu: FMU2Model | FMU3Model, folder: tempfile.TemporaryDirectory) -> None:
    """Free an instance and its library, and remove its files."""
    with suppress(Exception):  # of FMPy, or of an FMU after a fatal error
        fmu.freeInstance()
    folder.cleanup()


def _rk4(rates: Callable[[np.ndarray], np.ndarray], x: np.ndarray, dt: float) -> np.ndarray:
    """x' = x + dt/6 (k1 + 2 k2 + 2 k3 + k4), see `estimators/model/rk4.py`."""
    k1 = rates(x)
    k2 = rates(x + 0.5 * dt * k1)
    k3 = rates(x + 0.5 * dt * k2)
    k4 = rates(x + dt * k3)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
