"""The formulas of a model, read by running its functions on symbols, and their derivatives, as C.

A model's f, h and Q are plain Python that fills `out`. Run on symbols in place of numbers, they yield each entry of
`out` as a graph of operations, with equal operations shared. Where a comparison depends on a symbol, the function is
run once for either outcome, and the entry becomes `condition ? a : b`; so loops must end after a number of passes that
does not depend on x beyond such choices.

Derivatives are formed on the graph, forward from each state: they are exact, as those by complex step are.

Source: Griewank & Walther (2008), Evaluating Derivatives, chapter 3 (forward mode).
"""

from __future__ import annotations

import math
import operator
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import BuiltinFunctionType, CellType, FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from estimators.errors import ModelError
from estimators.numerics.jit import plain

MAX_PATHS = 512
"""Ways through a function that are followed; a table of twenty nodes takes about twenty."""

MAX_CHOICES = 64
"""Comparisons on one way through a function: more mean that a loop depends on the state."""

FUNCTIONS = {
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "expm1", "log", "log1p",
    "sqrt", "fabs", "floor", "pow",
}  # fmt: skip
"""Functions of <tgmath.h> that a model may call."""

NUMPY = {
    "arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2", "absolute": "fabs", "power": "pow",
    "add": "+", "subtract": "-", "multiply": "*", "divide": "/", "less": "<", "less_equal": "<=", "greater": ">",
    "greater_equal": ">=", "equal": "==", "not_equal": "!=",
}  # fmt: skip
"""NumPy's names of operations, where they are others."""


COMPARISONS: dict[str, Callable[..., bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip

ARITHMETIC: dict[str, Callable[..., float]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": lambda a, b: float(np.float64(a) / np.float64(b)),
}  # fmt: skip
"""Operations on numbers, and COMPARISONS; those by other names are functions of `math`."""

SLOPES: dict[str, Callable[..., Term]] = {
    "sin": lambda value, a: a.cos(),
    "cos": lambda value, a: -a.sin(),
    "tan": lambda value, a: 1.0 + value * value,
    "asin": lambda value, a: 1.0 / (1.0 - a * a).sqrt(),
    "acos": lambda value, a: -1.0 / (1.0 - a * a).sqrt(),
    "atan": lambda value, a: 1.0 / (1.0 + a * a),
    "sinh": lambda value, a: a.cosh(),
    "cosh": lambda value, a: a.sinh(),
    "tanh": lambda value, a: 1.0 - value * value,
    "exp": lambda value, a: value,
    "expm1": lambda value, a: value + 1.0,
    "log": lambda value, a: 1.0 / a,
    "log1p": lambda value, a: 1.0 / (1.0 + a),
    "sqrt": lambda value, a: 0.5 / value,
    "fabs": lambda value, a: a.reader.term("?", a < 0.0, -1.0, 1.0),
}
"""Derivatives of the functions of one argument a, from their value at a."""


class Term:
    """A number of a model that is not known yet: an operation and its terms, or a named symbol or a constant."""

    __slots__ = ("operation", "of", "reader")
    __array_priority__ = 1000

    def __init__(self, reader: Reader, operation: str, of: tuple[Any, ...]) -> None:
        self.reader, self.operation, self.of = reader, operation, of

    @property
    def real(self) -> Term:
        """Itself: a function that also runs on complex numbers compares real parts."""
        return self

    @property
    def constant(self) -> float | None:
        """Its value, if it is known."""
        return self.of[0] if self.operation == "constant" else None

    def _with(self, operation: str, *of: object) -> Term:
        return self.reader.term(operation, *of)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: object, **_: object) -> object:
        """Apply one of NumPy's functions."""
        if method != "__call__":
            return NotImplemented
        if any(isinstance(item, np.ndarray) and item.ndim for item in inputs):
            return ufunc(*(item.astype(object) if isinstance(item, np.ndarray) else item for item in inputs))
        return getattr(self, ufunc.__name__)() if ufunc.nin == 1 else self._with(_named(ufunc.__name__), *inputs)

    def __getattr__(self, name: str) -> Callable[..., Term]:
        """Return a function of the term by NumPy's name, as arrays of objects look it up."""
        found = _named(name)
        if found not in FUNCTIONS:
            raise AttributeError(name)
        return lambda *more: self._with(found, self, *more)

    def negative(self) -> Term:
        """Its negative, by NumPy's name."""
        return -self

    def square(self) -> Term:
        """Its square, by NumPy's name."""
        return self._with("*", self, self)

    def __float__(self) -> float:
        raise ModelError("turns a state, an input or a parameter into a plain number, by float() or as an index")

    __int__ = __index__ = __float__  # type: ignore[assignment]

    def __bool__(self) -> bool:
        return self.reader.choose(self)

    def __hash__(self) -> int:
        return id(self)

    def __pow__(self, power: object) -> Term:
        if isinstance(power, (int, float)) and power == int(power) and 1 <= power <= 8:
            result = self
            for _ in range(int(power) - 1):
                result = self._with("*", result, self)
            return result
        return self._with("pow", self, power)

    def __rpow__(self, base: object) -> Term:
        return self._with("pow", base, self)

    def __mod__(self, other: Any) -> Term:
        return self - self._with("floor", self / other) * other

    def __floordiv__(self, other: Any) -> Term:
        return self._with("floor", self / other)

    def __neg__(self) -> Term:
        return self._with("*", -1.0, self)

    def __pos__(self) -> Term:
        return self

    def __abs__(self) -> Term:
        return self._with("fabs", self)


def _operators() -> None:
    """Give `Term` Python's operators, each also with the term on the right."""

    def made(symbol: str, swapped: bool) -> Callable[[Term, object], object]:
        def operator(self: Term, other: object) -> object:
            if isinstance(other, np.ndarray) and other.ndim:
                return NotImplemented
            return self._with(symbol, *((other, self) if swapped else (self, other)))

        return operator

    for name, symbol in {"add": "+", "sub": "-", "mul": "*", "truediv": "/"}.items():
        setattr(Term, f"__{name}__", made(symbol, swapped=False))
        setattr(Term, f"__r{name}__", made(symbol, swapped=True))
    for name, symbol in {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}.items():
        setattr(Term, f"__{name}__", made(symbol, swapped=False))


_operators()


def _named(name: str) -> str:
    """Return the name in C of an operation by NumPy's name."""
    return NUMPY.get(name, name)


class UnmergedError(Exception):
    """The ways through a function return what no choice of C stands for, as an index."""


class Reader:
    """Runs a model's functions on symbols; terms that are equal are one."""

    def __init__(self) -> None:
        self._terms: dict[tuple[object, ...], Term] = {}
        self._given: tuple[tuple[Term, bool], ...] = ()  # choices of the callers
        self._path: list[tuple[Term, bool]] = []
        self._wanted: list[bool] = []
        self._functions: dict[int, Callable[..., object]] = {}
        self._kept: list[FunctionType] = []  # functions whose id is a key must live

    def symbols(self, name: str, size: int) -> np.ndarray:
        """Return the vector of the symbols name[0], name[1], …."""
        return self._vector([self.term("symbol", f"{name}[{k}]") for k in range(size)])

    def constant(self, value: float) -> Term:
        """Return the term of a number."""
        return self.term("constant", float(value))

    def term(self, operation: str, *of: Any) -> Term:
        """Return the term of an operation, simplified where a part is zero or one, or all are known."""
        if operation not in ("symbol", "constant"):
            if any(isinstance(item, complex) for item in of):
                raise ModelError("computes with complex numbers")
            of = tuple(item if isinstance(item, Term) else self.constant(item) for item in of)
            if (known := self._known(operation, of)) is not None:
                return known
        key = (operation, *(id(item) if isinstance(item, Term) else item for item in of))
        if key not in self._terms:
            self._terms[key] = Term(self, operation, of)
        return self._terms[key]

    def _known(self, operation: str, of: tuple[Term, ...]) -> Term | None:
        values = [item.constant for item in of]
        if operation == "?":
            return of[1] if of[1] is of[2] else None
        if operation in COMPARISONS:
            return None
        if all(value is not None for value in values):
            return self.constant((ARITHMETIC.get(operation) or getattr(math, operation))(*values))
        a, b = (values + [None])[:2]
        if operation == "+" and 0.0 in (a, b):
            return of[1] if a == 0.0 else of[0]
        if operation == "-" and b == 0.0:
            return of[0]
        if operation == "*" and 0.0 in (a, b):
            return self.constant(0.0)
        if operation == "*" and 1.0 in (a, b):
            return of[1] if a == 1.0 else of[0]
        if operation == "/" and (a == 0.0 or b == 1.0):
            return of[0]
        return None

    def choose(self, condition: Term) -> bool:
        """Return the outcome of a condition on the way through the function that is followed now."""
        if condition.operation not in COMPARISONS:
            condition = self.term("!=", condition, 0.0)
        values = [item.constant for item in condition.of]
        if None not in values:
            return COMPARISONS[condition.operation](*values)
        for known, outcome in (*self._given, *self._path):
            if known is condition:
                return outcome
        if len(self._path) >= MAX_CHOICES:
            raise ModelError(f"compares more than {MAX_CHOICES} times: a loop depends on the state")
        outcome = self._wanted[len(self._path)] if len(self._path) < len(self._wanted) else True
        self._path.append((condition, outcome))
        return outcome

    def read(self, function: Callable, arguments: Sequence[object], shape: tuple[int, ...]) -> np.ndarray:
        """Return `out` of this shape as terms, as function(*arguments, out) fills it.

        Raises:
            ModelError: If it cannot be followed, with the reason.
        """
        ready = self._readable(plain(function), called=False)
        out = self._vector([self.constant(0.0)] * math.prod(shape)).reshape(shape)
        try:
            self._along_all(ready, (*arguments, out))
        except ModelError as error:
            raise ModelError(f"{getattr(plain(function), '__qualname__', function)} {error}") from None
        except (TypeError, ValueError, AttributeError, LookupError) as error:
            name = getattr(plain(function), "__qualname__", function)
            raise ModelError(f"{name} cannot be read as formulas: {error}") from None
        return self._vector([self._term(item) for item in out.ravel()]).reshape(shape)

    def _along_all(self, function: Callable, arguments: Sequence[object]) -> object:
        """Run a function along all ways through it; return and leave in its arrays what depends on the way as a choice.

        Raises:
            UnmergedError: If the ways return what is neither numbers nor tuples of them.
        """
        arrays = [item for item in arguments if isinstance(item, np.ndarray) and item.dtype == object]
        before = [item.copy() for item in arrays]
        paths = 0

        def along(wanted: list[bool]) -> tuple[object, list[np.ndarray]]:
            nonlocal paths
            paths += 1
            if paths > MAX_PATHS:
                raise ModelError(f"has more than {MAX_PATHS} ways through its comparisons")
            self._path, self._wanted = [], wanted
            for item, values in zip(arrays, before, strict=True):
                item[...] = values
            result, path = function(*arguments), self._path
            contents = [item.copy() for item in arrays]
            # The ways that differ from this one, from its last choice backwards.
            for depth in range(len(path) - 1, len(wanted) - 1, -1):
                condition = path[depth][0]
                other, other_contents = along([outcome for _, outcome in path[:depth]] + [not path[depth][1]])
                result = self._chosen(condition, result, other)
                for values, other_values in zip(contents, other_contents, strict=True):
                    for place in np.ndindex(values.shape):
                        values[place] = self._chosen(condition, values[place], other_values[place])
            return result, contents

        outer = self._given, self._path, self._wanted
        self._given = (*self._given, *self._path)
        try:
            result, contents = along([])
        except BaseException:
            contents = before
            raise
        finally:
            self._given, self._path, self._wanted = outer
            for item, values in zip(arrays, contents, strict=True):
                item[...] = values
        return result

    def _chosen(self, condition: Term, a: object, b: object) -> object:
        if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
            return tuple(self._chosen(condition, one, other) for one, other in zip(a, b, strict=True))
        if a is b or (type(a) is type(b) and not isinstance(a, (Term, np.ndarray)) and a == b):
            return a
        if all(isinstance(item, (Term, float)) for item in (a, b)):
            return self.term("?", condition, a, b)
        raise UnmergedError

    def _term(self, item: Any) -> Term:
        return item if isinstance(item, Term) else self.constant(item)

    @staticmethod
    def _vector(terms: list[Term]) -> np.ndarray:
        found = np.empty(len(terms), object)
        for k, item in enumerate(terms):
            found[k] = item
        return found

    def _merging(self, function: Callable) -> Callable[..., object]:
        """Return a function whose choices end with its call, unless what it returns cannot be merged."""

        def call(*arguments: object) -> object:
            try:
                return self._along_all(function, arguments)
            except UnmergedError:
                return function(*arguments)

        return call

    def _readable(self, function: object, *, called: bool = True) -> Any:
        """Return the function with plain ones in place of the compiled ones that it calls, and `math` for symbols."""
        if isinstance(function, ModuleType) and function.__name__ in ("math", "cmath"):
            return SimpleNamespace(**{**vars(math), **{name: self._function(name) for name in FUNCTIONS}})
        inner = plain(function)
        if isinstance(inner, BuiltinFunctionType) and inner.__module__ == "math" and inner.__name__ in FUNCTIONS:
            return self._function(inner.__name__)
        if not isinstance(inner, FunctionType) or str(inner.__module__).split(".")[0] in ("numpy", "scipy", "numba"):
            return function
        if called and id(inner) in self._functions:
            return self._functions[id(inner)]
        world = dict(inner.__globals__)
        cells = [CellType() for _ in inner.__closure__ or ()]
        made = FunctionType(inner.__code__, world, inner.__name__, inner.__defaults__, tuple(cells) or None)
        self._functions[id(inner)] = self._merging(made)
        self._kept.append(inner)
        for name in _names(inner):
            if name in world:
                world[name] = self._readable(world[name])
        for cell, given in zip(cells, inner.__closure__ or (), strict=True):
            cell.cell_contents = self._readable(given.cell_contents)
        return self._functions[id(inner)] if called else made

    def _function(self, name: str) -> Callable[..., object]:
        def apply(*of: Term | float) -> object:
            if any(isinstance(item, Term) for item in of):
                return self.term(name, *of)
            return getattr(math, name)(*of)

        return apply

    def jacobian(self, outputs: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, n) of terms (m,) by symbols (n,)."""
        found, terms = np.empty((outputs.size, x.size), object), in_order(outputs.tolist())
        for j, symbol in enumerate(x):
            known: dict[int, Term] = {}
            for item in terms:
                known[id(item)] = self._derivative(item, symbol, known)
            found[:, j] = [known[id(item)] for item in outputs]
        return found

    def _derivative(self, term: Term, symbol: Term, known: Mapping[int, Term]) -> Term:
        if term is symbol:
            return self.constant(1.0)
        if term.operation in ("symbol", "constant", "floor") or term.operation in COMPARISONS:
            return self.constant(0.0)
        if term.operation == "?":
            condition, a, b = term.of
            return self.term("?", condition, known[id(a)], known[id(b)])
        slopes: list[Any] = [known[id(item)] for item in term.of]
        if all(slope.constant == 0.0 for slope in slopes):
            return self.constant(0.0)
        a, b = (*term.of, None)[:2]
        da, db = (*slopes, None)[:2]
        value: Any = term
        match term.operation:
            case "+":
                return da + db
            case "-":
                return da - db
            case "*":
                return da * b + a * db
            case "/":
                return (da - value * db) / b
            case "pow":
                first = b * self.term("pow", a, b - 1.0) * da
                return first if db.constant == 0.0 else first + value * self.term("log", a) * db
            case "atan2":
                return (b * da - a * db) / (a * a + b * b)
        return da * SLOPES[term.operation](term, a)


def _names(function: FunctionType) -> Iterator[str]:
    """Yield the names that a function and those within it look up."""
    codes = [function.__code__]
    while codes:
        code = codes.pop()
        yield from code.co_names
        codes += [item for item in code.co_consts if hasattr(item, "co_names")]


def in_order(terms: Sequence[Term]) -> list[Term]:
    """Return the terms with all their parts, each after its own parts."""
    found: dict[int, Term] = {}
    open_terms: list[tuple[Term, bool]] = [(item, False) for item in reversed(terms)]
    while open_terms:
        item, done = open_terms.pop()
        if id(item) in found:
            continue
        if done:
            found[id(item)] = item
            continue
        open_terms.append((item, True))
        open_terms += [(part, False) for part in reversed(item.of) if isinstance(part, Term)]
    return list(found.values())


def number(value: float) -> str:
    """Return a number as C, of the precision of the build."""
    if not math.isfinite(value):
        return "NAN" if math.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
    return f"R({value!r})"


class Statements:
    """C statements that assign terms to places; a term that is used twice has a name of its own."""

    def __init__(self, assigned: Sequence[tuple[str, Term]]) -> None:
        terms = in_order([term for _, term in assigned])
        uses = Counter(id(part) for item in terms for part in item.of)
        uses.update(id(term) for _, term in assigned)
        self.operations = [item.operation for item in terms if item.operation not in ("symbol", "constant")]
        """Operations that the statements carry out."""
        self._texts: dict[int, str] = {}
        self.lines: list[str] = []
        for item in terms:
            text = self._text(item)
            if uses[id(item)] > 1 and item.operation not in ("symbol", "constant"):
                name = f"t{len(self.lines)}"
                kind = "int" if item.operation in COMPARISONS else "real"
                self.lines.append(f"const {kind} {name} = {text};")
                text = name
            self._texts[id(item)] = text
        self.lines += [f"{place} = {self._texts[id(term)]};" for place, term in assigned]

    def _text(self, item: Term) -> str:
        if item.operation == "symbol":
            return str(item.of[0])
        if item.operation == "constant":
            return number(item.of[0])
        of = [self._texts[id(part)] for part in item.of]
        if item.operation == "?":
            return f"({of[0]} ? {of[1]} : {of[2]})"
        if item.operation in FUNCTIONS:
            return f"{item.operation}({', '.join(of)})"
        return f"({of[0]} {item.operation} {of[1]})"
