"""The small mistakes themselves, made from a module's syntax tree. Pure.

What may change: comparisons, `and` and `or`, `not`, arithmetic, numbers, words, `True` and `False`, `min` and `max` and
their like; what is returned may be nothing of its kind; any statement that acts may be missing. One place changes at a
time, all other bytes stay.

Left out by rule, since no test should notice it: annotations and aliases of types, decorators, docstrings, `assert` and
`strict=` (they say what is so anyhow), logging, what an exception says, f-strings, and any text with a space in it (it is
for people).
"""

from __future__ import annotations

import ast
import difflib
from collections.abc import Iterator
from dataclasses import dataclass

COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
"""The limit itself on the other side, and the opposite."""
RECKONED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult, ast.BitOr: ast.BitAnd, ast.BitAnd: ast.BitOr,
}  # fmt: skip
NOTHING = {"str": '""', "float": "0.0", "int": "0", "list": "[]", "dict": "{}", "frozenset": "frozenset()"}
"""What a function of this type could return instead, without mypy's noticing."""
CALLED = {"min": "max", "max": "min", "any": "all", "all": "any", "sorted": "list"}
LOGGERS = ("_log", "log")
Function = ast.FunctionDef | ast.AsyncFunctionDef
Change = tuple[ast.expr | ast.stmt, str]
"""A node, and the text that takes its place."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One mistake: `text` instead of the bytes `start` to `end` of the module."""

    start: int
    end: int
    text: str
    line: int
    """Counted from 1."""
    lines: range
    """Those of the statement it is in; of a block only its head. Empty outside functions: that runs at import."""

    def put_into(self, source: bytes) -> bytes:
        return source[: self.start] + self.text.encode() + source[self.end :]

    def diff(self, source: bytes) -> str:
        """Lines taken out and put in."""
        before, after = source.decode().splitlines(), self.put_into(source).decode().splitlines()
        changed = difflib.unified_diff(before, after, n=0, lineterm="")
        return "\n".join(line for line in list(changed)[2:] if not line.startswith("@@"))


def mutants(source: bytes) -> list[Mutant]:
    """All mistakes that the rules make of a module, in the order of its lines."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    made = []
    for (node, text), lines in _of_block(ast.parse(source).body, None):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        made.append(Mutant(start, end, text, node.lineno, lines))
    return sorted(set(made), key=lambda mutant: (mutant.start, mutant.end, mutant.text))


def _of_block(statements: list[ast.stmt], function: Function | None) -> Iterator[tuple[Change, range]]:
    for statement in statements:
        if _left_out(statement, function is not None):
            continue
        inner = [block for block in _blocks(statement) if block]
        last = min((block[0].lineno for block in inner), default=(statement.end_lineno or 0) + 1)
        lines = range(statement.lineno, max(last, statement.lineno + 1)) if function else range(0)
        for change in _of_statement(statement, function):
            yield change, lines
        for block in inner:
            yield from _of_block(block, statement if isinstance(statement, Function) else function)


def _blocks(statement: ast.stmt) -> Iterator[list[ast.stmt]]:
    for name in ("body", "orelse", "finalbody"):
        yield getattr(statement, name, [])
    for part in (*getattr(statement, "handlers", ()), *getattr(statement, "cases", ())):
        yield part.body


def _left_out(statement: ast.stmt, in_function: bool) -> bool:
    match statement:
        case ast.Import() | ast.ImportFrom() | ast.Assert() | ast.Expr(value=ast.Constant()):
            return True
        case ast.Expr(value=ast.Call(func=ast.Attribute(value=ast.Name(id=name)))):
            return name in LOGGERS
        case ast.Assign(targets=[ast.Name(id=name)]):
            return not in_function and not name.isupper() and name[:1].isupper()  # an alias of a type
    return False


def _of_statement(statement: ast.stmt, function: Function | None) -> Iterator[Change]:
    """Changes of a statement itself and of the expressions in it, not of the blocks below it."""
    match statement:
        case ast.Raise() | ast.Break() | ast.Continue() | ast.Delete():
            yield statement, "pass"
            return
        case ast.Expr(value=ast.Call() | ast.Await()) | ast.Return(value=None):
            yield statement, "pass"
        case ast.AugAssign(target=target, op=op, value=value):
            yield statement, "pass"
            if (other := RECKONED.get(type(op))) is not None:
                yield statement, ast.unparse(ast.AugAssign(target=target, op=other(), value=value))
        case ast.Assign(targets=targets) if any(_is_kept(target) for target in targets):
            yield statement, "pass"
        case ast.Return(value=ast.expr() as value) if function is not None and function.returns is not None:
            nothing = _nothing(function.returns)
            if nothing and ast.unparse(value) not in (nothing, "''"):
                yield value, nothing
            elif ast.unparse(function.returns) == "bool":
                yield from _negated(value)
        case ast.If(test=test) | ast.While(test=test):
            yield from _negated(test)
    for expression in _expressions(statement):
        yield from _of_expression(expression)


def _expressions(statement: ast.stmt) -> Iterator[ast.expr]:
    match statement:
        case ast.FunctionDef(args=args) | ast.AsyncFunctionDef(args=args):
            yield from (default for default in (*args.defaults, *args.kw_defaults) if default is not None)
        case ast.ClassDef():
            return
        case ast.AnnAssign(value=value):
            yield from () if value is None else (value,)
        case ast.Match(subject=subject, cases=cases):
            yield subject
            yield from (case.guard for case in cases if case.guard is not None)
        case ast.With(items=items) | ast.AsyncWith(items=items):
            yield from (item.context_expr for item in items)
        case _:
            yield from (child for child in ast.iter_child_nodes(statement) if isinstance(child, ast.expr))


def _of_expression(node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.JoinedStr):
        return
    if isinstance(node, ast.expr):
        for text in _instead(node):
            yield node, text
    for test in (*([node.test] if isinstance(node, ast.IfExp) else ()), *getattr(node, "ifs", ())):
        yield from _negated(test)
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.keyword) and child.arg == "strict"):
            yield from _of_expression(child)


def _negated(test: ast.expr) -> Iterator[Change]:
    """What is not negated in another way already."""
    if not isinstance(test, (ast.Compare, ast.Constant)) and not _is_not(test):
        yield test, f"(not ({ast.unparse(test)}))"


def _instead(node: ast.expr) -> Iterator[str]:
    match node:
        case ast.Constant(value=value):
            yield from _other_constant(value)
        case ast.Compare(left=left, ops=ops, comparators=right):
            for i, op in enumerate(ops):
                for other in COMPARED[type(op)]:
                    yield _text(ast.Compare(left=left, ops=[*ops[:i], other(), *ops[i + 1 :]], comparators=right))
        case ast.BoolOp(op=op, values=values):
            yield _text(ast.BoolOp(op=ast.Or() if isinstance(op, ast.And) else ast.And(), values=values))
            for i in range(len(values)):
                left_over = [*values[:i], *values[i + 1 :]]
                yield _text(left_over[0] if len(left_over) == 1 else ast.BoolOp(op=op, values=left_over))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in RECKONED and not (_is_text(left) or _is_text(right)):
            yield _text(ast.BinOp(left=left, op=RECKONED[type(op)](), right=right))
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield _text(operand)
        case ast.Call(func=ast.Name(id="abs"), args=[value]):
            yield _text(value)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=keywords) if name in CALLED:
            if name != "sorted" or not keywords:
                yield _text(ast.Call(func=ast.Name(id=CALLED[name], ctx=ast.Load()), args=args, keywords=keywords))


def _other_constant(value: object) -> Iterator[str]:
    match value:
        case bool():
            yield str(not value)
        case int():
            yield str(value + 1)
        case float():
            yield repr(2.0 * value or 1.0)
        case str() if " " not in value:
            yield repr("XX" + value)
        case bytes() if b" " not in value:
            yield repr(b"XX" + value)


def _text(node: ast.expr) -> str:
    return f"({ast.unparse(node)})"


def _is_kept(target: ast.expr) -> bool:
    """Whether an assignment changes more than a name of the function's own, whose absence anything would notice."""
    if isinstance(target, ast.Tuple):
        return any(_is_kept(each) for each in target.elts)
    return isinstance(target, (ast.Attribute, ast.Subscript))


def _nothing(returns: ast.expr) -> str:
    kinds = {ast.unparse(node) for node in ast.walk(returns) if isinstance(node, (ast.Name, ast.Constant))}
    outer = returns.value if isinstance(returns, ast.Subscript) else returns
    if isinstance(returns, ast.BinOp) and "None" in kinds:
        return "None"
    return NOTHING.get(ast.unparse(outer), "")


def _is_not(node: ast.expr) -> bool:
    return isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))
