"""Functions with loops and branches that become part of the kernels that call them, see `traced`.

The statements of a function that is `written` are taken one by one from its source: `for` over a range, `while True` and `if`
become jumps, and only expressions run as plain Python, on symbols. A name that is bound at one place stands for what it is
bound to; one that is bound at several has a place in memory, from which the compiler takes it into a register, and keeps the
kind that it is bound to first.
"""

import ast
import inspect
import operator
import textwrap
from functools import cached_property, wraps
from typing import Any

from numba import types
from numba.core import cgutils

from tca_envs.mechanics.traced import Function, Symbol, as_kind, emit, kind_of, traced, traces, where


def written(function: Function) -> Function:
    """Let kernels trace a function that loops and branches, see above."""
    program = _Program(function)

    @wraps(function)  # type: ignore[arg-type]
    def call(*arguments):
        return _Writer(program, arguments).result if traces.builders else function(*arguments)  # type: ignore[operator]

    return traced(call)  # type: ignore[return-value]


class _Program:
    """The source of a function, read where it is first wanted: kernels that are in the cache need none."""

    def __init__(self, function: Any) -> None:
        self.function, self.globals = function, {"_where": where, "_opposite": _opposite}
        self.codes: dict[ast.expr, Any] = {}

    @cached_property
    def definition(self) -> ast.FunctionDef:
        lines, first = inspect.getsourcelines(self.function)
        tree = ast.increment_lineno(ast.parse(textwrap.dedent("".join(lines))), first - 1)
        self.globals = {**self.function.__globals__, **self.globals}
        return ast.fix_missing_locations(_Expressions().visit(tree)).body[0]

    @cached_property
    def parameters(self) -> list[str]:
        return [argument.arg for argument in self.definition.args.args]

    @cached_property
    def variable(self) -> set[str]:
        """The names that are bound at several places."""
        bound = [n.id for n in ast.walk(self.definition) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
        bound += self.parameters
        return {name for name in bound if bound.count(name) > 1}

    def value(self, node: ast.expr, names: dict[str, Any]) -> Any:
        """Return the value of an expression."""
        if node not in self.codes:
            self.codes[node] = compile(ast.Expression(node), inspect.getsourcefile(self.function) or "", "eval")
        return eval(self.codes[node], self.globals, names)


class _Expressions(ast.NodeTransformer):
    """Replaces what Python would decide when it evaluates an expression."""

    def visit_IfExp(self, node):
        self.generic_visit(node)
        return ast.copy_location(_call("_where", node.test, node.body, node.orelse), node)

    def visit_UnaryOp(self, node):
        self.generic_visit(node)
        return ast.copy_location(_call("_opposite", node.operand), node) if isinstance(node.op, ast.Not) else node


def _call(name, *arguments):
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def _opposite(flag):
    if not isinstance(flag, Symbol):
        return not flag
    return emit(flag.kind, lambda builder, x: builder.not_(x), flag)


def _each(change, state):
    return tuple(_each(change, x) for x in state) if isinstance(state, tuple) else change(state)


def _flat(state):
    return [leaf for x in state for leaf in _flat(x)] if isinstance(state, tuple) else [state]


class _Cell:
    """A place in memory for what a name is bound to."""

    def __init__(self, value: Any) -> None:
        self.places = _each(self._place, value)

    @staticmethod
    def _place(value):
        kind, builder = kind_of(value), traces.builders[-1]
        place = None if builder is None else cgutils.alloca_once(builder, as_kind(kind, value).value.type)
        return Symbol(types.CPointer(kind), place)

    def store(self, value):
        for place, x in zip(_flat(self.places), _flat(value), strict=True):
            emit(None, lambda builder, p, v: builder.store(v, p), place, as_kind(place.kind.dtype, x))

    def load(self):
        return _each(lambda place: emit(place.kind.dtype, lambda builder, p: builder.load(p), place), self.places)


class _Names(dict):
    def __getitem__(self, name):
        value = super().__getitem__(name)
        return value.load() if isinstance(value, _Cell) else value


_OPERATIONS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.BitOr: operator.or_,
}


class _Writer:
    """Writes the instructions of a function's statements; methods return whether control reaches what is behind."""

    def __init__(self, program: _Program, arguments: Any) -> None:
        self.program, self.names, self.builder = program, _Names(), traces.builders[-1]
        self.loops: list[Any] = []
        self.result: Any = None
        self.end = self._block()
        for name, value in zip(program.parameters, arguments, strict=True):
            self._bind(name, value)
        if self._run(program.definition.body):
            self._jump(self.end)
        self._go(self.end)

    def _block(self):
        return None if self.builder is None else self.builder.append_basic_block("written")

    def _jump(self, block):
        if self.builder is not None:
            self.builder.branch(block)

    def _go(self, block):
        if self.builder is not None:
            self.builder.position_at_end(block)

    def _value(self, node):
        return self.program.value(node, self.names)

    def _run(self, statements):
        for statement in statements:
            try:
                if not getattr(self, f"_{type(statement).__name__}")(statement):
                    return False
            except Exception as error:
                if not hasattr(error, "__notes__"):
                    error.add_note(f"while writing line {statement.lineno} of {self.program.function.__name__}")
                raise
        return True

    def _bind(self, name, value):
        if name == "_":
            return
        if name not in self.program.variable:
            self.names[name] = value
            return
        if name not in self.names:
            self.names[name] = _Cell(value)
        cell = dict.__getitem__(self.names, name)
        try:
            cell.store(value)
        except (TypeError, ValueError):
            raise TypeError(f"{name} of {self.program.function.__name__} is bound to values of several kinds") from None

    def _put(self, target, value):
        if isinstance(target, ast.Tuple):
            for part_of, x in zip(target.elts, value, strict=True):
                self._put(part_of, x)
        elif isinstance(target, ast.Subscript):
            self._value(target.value)[self._value(target.slice)] = value
        else:
            self._bind(target.id, value)

    def _Assign(self, statement):
        value = self._value(statement.value)
        for target in statement.targets:
            self._put(target, value)
        return True

    def _AugAssign(self, statement):
        operation, target = _OPERATIONS[type(statement.op)], statement.target
        value = self._value(statement.value)
        if isinstance(target, ast.Name):
            self._bind(target.id, operation(self.names[target.id], value))
        else:
            pointer, place = self._value(target.value), self._value(target.slice)
            pointer[place] = operation(pointer[place], value)
        return True

    def _Expr(self, statement):
        self._value(statement.value)
        return True

    def _Return(self, statement):
        if statement.value is not None:
            if statement not in self.program.definition.body[-1:]:
                raise SyntaxError("only the last statement returns a value")
            self.result = self._value(statement.value)
        self._jump(self.end)
        return False

    def _If(self, statement):
        flag = self._value(statement.test)
        if not isinstance(flag, Symbol):
            return self._run(statement.body if flag else statement.orelse)
        then, otherwise, behind, reached = self._block(), self._block(), self._block(), False
        if self.builder is not None:
            self.builder.cbranch(flag.value, then, otherwise)
        for block, statements in ((then, statement.body), (otherwise, statement.orelse)):
            self._go(block)
            if self._run(statements):
                self._jump(behind)
                reached = True
        self._go(behind)
        if not reached and self.builder is not None:
            self.builder.unreachable()
        return reached

    def _For(self, statement):
        given = [self._value(argument) for argument in statement.iter.args]
        first, last = (0, given[0]) if len(given) == 1 else given[:2]
        step = given[2] if len(given) == 3 else 1
        counter = _Cell(as_kind(types.int64, first))
        counter.store(first)
        head, body, onward, behind = self._block(), self._block(), self._block(), self._block()
        self._jump(head)
        self._go(head)
        k = counter.load()
        going = k < last if step > 0 else k > last
        if self.builder is not None:
            self.builder.cbranch(going.value, body, behind)
        self._go(body)
        self._bind(statement.target.id, k)
        self._loop(statement.body, onward, behind)
        self._go(onward)
        counter.store(k + step)
        self._jump(head)
        self._go(behind)
        return True

    def _While(self, statement):
        if not isinstance(statement.test, ast.Constant):
            raise SyntaxError("expected `while True`")
        body, behind = self._block(), self._block()
        self._jump(body)
        self._go(body)
        self._loop(statement.body, body, behind)
        self._go(behind)
        return True

    def _loop(self, statements, onward, behind):
        self.loops.append((onward, behind))
        if self._run(statements):
            self._jump(onward)
        self.loops.pop()

    def _Continue(self, statement):
        self._jump(self.loops[-1][0])
        return False

    def _Break(self, statement):
        self._jump(self.loops[-1][1])
        return False
