"""Addresses of a model's functions, and machine code that many sensors share.

Numba takes the values that a function encloses as constants, so 4,000 channels `gain * x[zone]` would be compiled 4,000
times. Here the values in which such functions differ become arguments of one compiled function, and each sensor has a
stub of a few instructions that calls it with its own.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from inspect import Parameter, Signature
from types import CellType, FunctionType
from typing import Any
from uuid import UUID

import numpy as np
from llvmlite import binding, ir
from numba import typeof, types
from numba.core import ir as numba_ir
from numba.core.compiler import CompilerBase, DefaultPassBuilder, StateDict
from numba.core.compiler_machinery import FunctionPass, PassManager, register_pass
from numba.core.errors import NumbaError
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.typing import Signature as TypeSignature
from numba.core.untyped_passes import TranslateByteCode
from numpy.typing import ArrayLike

from ..model.check import uncompilable
from ..model.state_space import StateSpaceModel
from ..numerics.helpers import source_digest, with_helpers
from ..numerics.jit import address, jit, plain
from .context import call_F, call_H, call_h_rows

MIN_SHARED = 16
"""Functions of equal code from which on they share it; fewer are compiled by themselves, with their constants."""

MAX_INTEGER = 2**63
"""Numbers from which on Numba has no integer."""

STUBS_PER_MODULE = 500
"""Stubs that are compiled at once; LLVM's time grows faster than the size of a module."""


@jit
def call_h(target, x, u, p, out):
    """out = h(x, u, p) of the function over rows at an address."""
    call_h_rows(target, x.ctypes.data, 0, 1, u.ctypes.data, p.ctypes.data, out.ctypes.data, 0)


@jit
def call_h_block(target, X, u, p, out):
    """Rows of `out` (N, ny) = h of the function over rows at an address, at the rows of X (N, nx)."""
    rows, stride = X.shape
    call_h_rows(target, X.ctypes.data, stride, rows, u.ctypes.data, p.ctypes.data, out.ctypes.data, out.shape[1])


@jit
def call_own_F(target, x, u, p, dt, out):
    """out = F(x, u, p, dt) of the function at an address."""
    call_F(target, x, u, p, dt, out)


@jit
def call_own_H(target, x, u, p, out):
    """out = H(x, u, p) of the function at an address."""
    call_H(target, x, u, p, out)


class ModelCode:
    """Compiles a model's functions, and keeps their code alive."""

    def __init__(self, model: StateSpaceModel) -> None:
        self._model = model
        self._sizes = [len(sensor.rows) for sensor in model.sensors]
        self.kept: list[object] = []

    def compiled(self, function: Callable, signature: TypeSignature, what: str) -> CPUDispatcher:
        """Return the dispatcher of a function that is compiled for a signature.

        Raises:
            ModelError: If it cannot be compiled.
        """
        try:
            dispatcher = jit(with_helpers(plain(function)))
            self.address(dispatcher, signature)
        except NumbaError as error:
            raise uncompilable(self._model, what, function, error) from None
        return dispatcher

    def address(self, dispatcher: CPUDispatcher, signature: TypeSignature) -> int:
        """Compile a dispatcher, and return where its code starts."""
        self.kept.append(dispatcher)
        return address(dispatcher, signature)

    def of(self, function: Callable | None, signature: TypeSignature, what: str) -> int:
        """Return the address of a function, 0 if the model has none; raises as `compiled`."""
        return 0 if function is None else address(self.compiled(function, signature, what), signature)

    def over_complex(self, function: Any, signature: TypeSignature) -> int:
        """Return the address of a function over complex numbers, or 0 if it is not analytic (comparisons, abs, atan2).

        Numba raises many kinds of errors; each means the same here.
        """
        with warnings.catch_warnings(), suppress(Exception):
            warnings.simplefilter("ignore")
            ready = plain(function) is not function
            return self.address(function if ready else jit(with_helpers(function)), signature)
        return 0

    def of_sensors(
        self,
        functions: Sequence[Callable | None],
        signature: TypeSignature,
        own: Callable[[int], int],
        common: Callable[[SharedCode], int],
    ) -> list[int]:
        """Return the address of each sensor's function, 0 without one.

        Args:
            functions: The function of each sensor.
            signature: Signature of the functions at the addresses.
            own: Function that compiles that of sensor k.
            common: Function that compiles shared code, 0 if it cannot be.
        """
        found: dict[int, int] = {}
        for shared in shared_codes(functions, self._sizes):
            with suppress(NumbaError):  # code that needs the values as constants is compiled for each
                target = common(shared)
                stubs = Stubs(target, signature, shared) if target else None
                self.kept.append(stubs)
                found |= zip(shared.members, stubs.addresses if stubs else [0] * len(shared.members), strict=True)
        same: dict[tuple[Callable | None, int], int] = {}
        for k, (function, size) in enumerate(zip(functions, self._sizes, strict=True)):
            if k in found:
                continue
            if (function, size) not in same:
                same[function, size] = 0 if function is None else own(k)
            found[k] = same[function, size]
        return [found[k] for k in range(len(functions))]


@dataclass(frozen=True)
class Lifted:
    """Stands in a closure for a value that has become an argument."""

    argument: str


@register_pass(mutates_CFG=False, analysis_only=False)
class LiftedValues(FunctionPass):  # type: ignore[misc]
    """Numba pass: reads lifted values from arguments, and hands those of an enclosed function to it."""

    _name = "lifted_values"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: StateDict) -> bool:
        """Change the function in place."""
        code, passed_on = state.func_ir, state.func_id.func.__passed_on__
        for block in code.blocks.values():
            for statement in block.body:
                if not isinstance(statement, numba_ir.Assign):
                    continue
                value = statement.value
                if isinstance(value, numba_ir.FreeVar) and isinstance(value.value, Lifted):
                    statement.value = block.scope.get_exact(value.value.argument)
                    code._definitions[statement.target.name] = [statement.value]
                elif isinstance(value, numba_ir.Expr) and value.op == "call":
                    called = code._definitions[value.func.name][0]
                    names = passed_on.get(called.name, ()) if isinstance(called, numba_ir.FreeVar) else ()
                    value.args = [*value.args, *map(block.scope.get_exact, names)]
        return True


class LiftedCompiler(CompilerBase):  # type: ignore[misc]
    """Numba's compiler with that pass."""

    def define_pipelines(self) -> list[PassManager]:
        """Return the pipeline."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(LiftedValues, TranslateByteCode)
        passes.finalize()
        return [passes]


@dataclass(frozen=True)
class SharedCode:
    """One dispatcher for functions of equal code, with further arguments `types` after its own.

    `values` has those of each of the functions, whose places in the given sequence are `members`.
    """

    members: tuple[int, ...]
    dispatcher: CPUDispatcher
    types: tuple[object, ...]
    values: tuple[tuple[object, ...], ...]

    def with_own(self, signature: TypeSignature) -> tuple[CPUDispatcher, TypeSignature]:
        """Return the dispatcher, and its signature: one of the functions' own and the further arguments."""
        return self.dispatcher, signature.return_type(*signature.args, *self.types)


def shared_codes(functions: Sequence[Callable | None], sizes: Sequence[int]) -> Iterator[SharedCode]:
    """Yield the code of each group of at least `MIN_SHARED` functions of one size that differ in enclosed values only.

    Args:
        functions: Functions of one signature.
        sizes: Number of rows that each fills.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    for k, (function, size) in enumerate(zip(functions, sizes, strict=True)):
        python = plain(function)
        if isinstance(python, FunctionType) and python.__closure__:
            groups.setdefault((size, _kind(python)), []).append(k)
    for members in groups.values():
        if len(members) < MIN_SHARED:
            continue
        dispatcher, values = _lifted([plain(functions[k]) for k in members])
        if values:
            yield SharedCode(tuple(members), dispatcher, tuple(map(_type, values[0])), tuple(values))


def _kind(function: FunctionType) -> tuple[object, ...]:
    """Return a key that functions have in common if they differ in enclosed numbers, arrays and tuples of them only."""
    cells: list[object] = []
    for cell in function.__closure__ or ():
        value = cell.cell_contents
        inner = plain(value)
        if isinstance(inner, FunctionType) and inner.__closure__:
            cells.append(_kind(inner))
        else:
            cells.append(_type(value) or id(inner))
    return function.__code__, id(function.__globals__), repr(function.__defaults__), tuple(cells)


def _type(value: Any) -> types.Type | None:
    """Return Numba's type of a value that can be an argument; None if it cannot."""
    if isinstance(value, tuple):
        inside = tuple(map(_type, value))
        return types.BaseTuple.from_types(inside) if inside and all(inside) else None
    if isinstance(value, np.ndarray):
        passed = value.dtype in (np.float64, np.int64) and value.flags.c_contiguous
        return typeof(value).copy(readonly=True) if passed else None
    number = isinstance(value, (bool, int, float, np.bool_, np.integer, np.floating))
    return typeof(value) if number and abs(value) < MAX_INTEGER else None


def _lifted(functions: list[Any]) -> tuple[CPUDispatcher, list[tuple[object, ...]]]:
    """Return a dispatcher for functions of one kind, and the values of each; none if they are all equal."""
    first = with_helpers(functions[0])
    cells: list[CellType] = []
    lifted: list[list[object]] = []
    passed_on: dict[str, tuple[str, ...]] = {}
    rows = [[cell.cell_contents for cell in function.__closure__] for function in functions]
    # Of each enclosed name: what stands in the closure of the first function, and the values of all.
    for name, cell, *column in zip(first.__code__.co_freevars, first.__closure__ or (), *rows, strict=True):
        value = cell.cell_contents
        inner = plain(column[0])
        if isinstance(inner, FunctionType) and any(plain(item) is not inner for item in column):
            dispatcher, values = _lifted([plain(item) for item in column])
            if values:
                value = dispatcher
                passed_on[name] = tuple(f"lifted_{len(lifted) + k}" for k in range(len(values[0])))
                lifted += [list(entries) for entries in zip(*values, strict=True)]
        elif _type(value) is not None and any(not _same(item, value) for item in column):
            value = Lifted(f"lifted_{len(lifted)}")
            lifted.append(column)
        cells.append(CellType(value))
    if not lifted:
        return first, []
    made = FunctionType(first.__code__, first.__globals__, first.__name__, first.__defaults__, tuple(cells))
    made.__kwdefaults__, made.__module__ = first.__kwdefaults__, first.__module__
    made.__qualname__ = f"{first.__qualname__}_shared"
    own = Signature.from_callable(first).parameters.values()
    more = [Parameter(f"lifted_{k}", Parameter.POSITIONAL_OR_KEYWORD) for k in range(len(lifted))]
    made.__signature__ = Signature([*own, *more])  # type: ignore[attr-defined]
    made.__passed_on__ = passed_on  # type: ignore[attr-defined]
    dispatcher = jit(pipeline_class=LiftedCompiler)(made)
    dispatcher._set_uuid(str(UUID(source_digest([made])[:32])))  # by which a function that encloses it is cached
    return dispatcher, list(zip(*lifted, strict=True))


def _same(a: ArrayLike, b: ArrayLike) -> bool:
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    return bool(a == b)


class Stubs:
    """Functions of a signature without the last argument of shared code, a tuple; one for each row of values.

    Args:
        target: Address of the shared code.
        signature: Its Numba signature without the tuple.
        shared: The tuples.
    """

    def __init__(self, target: int, signature: TypeSignature, shared: SharedCode) -> None:
        convention = cpu_target.target_context.call_conv
        own = convention.get_function_type(signature.return_type, signature.args)
        full = convention.get_function_type(signature.return_type, (*signature.args, types.Tuple(shared.types)))
        given = ", ".join(f"{kind} %a{k}" for k, kind in enumerate(own.args))
        kinds = full.args[len(own.args) :]
        call = f"call {own.return_type} inttoptr (i64 {target} to {ir.PointerType(full)})"
        self._engines: list[binding.ExecutionEngine] = []
        self._arrays = shared.values
        self.addresses: list[int] = []
        for begin in range(0, len(shared.values), STUBS_PER_MODULE):
            text = []
            for k, values in enumerate(shared.values[begin : begin + STUBS_PER_MODULE]):
                constants = [_constant(kind, item) for kind, item in zip(kinds, _passed(values), strict=True)]
                body = f"  %r = {call}({', '.join([given, *constants])})\n  ret {own.return_type} %r\n"
                text.append(f"define {own.return_type} @stub{k}({given}) {{\n{body}}}\n")
            machine = binding.Target.from_default_triple().create_target_machine(opt=0, codemodel="jitdefault")
            engine = binding.create_mcjit_compiler(binding.parse_assembly("\n".join(text)), machine)
            engine.finalize_object()
            self._engines.append(engine)
            self.addresses += [engine.get_function_address(f"stub{k}") for k in range(len(text))]


def _passed(value: Any) -> Iterator[float | int]:
    """Yield the numbers by which Numba passes a value; of an array: no owner, sizes, address, shape and strides."""
    if isinstance(value, tuple):
        for item in value:
            yield from _passed(item)
    elif isinstance(value, np.ndarray):
        yield from (0, 0, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides)
    else:
        yield value


def _constant(kind: ir.Type, value: float | int) -> str:
    """Return a constant of an LLVM type as text."""
    if isinstance(kind, ir.PointerType):
        return f"{kind} inttoptr (i64 {int(value)} to {kind})"
    return f"{kind} {ir.Constant(kind, int(value) if isinstance(kind, ir.IntType) else float(value)).get_reference()}"
