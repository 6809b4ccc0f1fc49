"""The operators: what can be changed in one line of a module, so that the tests should notice."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

FLIPPED: dict[type[ast.AST], tuple[str, tuple[str, ...]]] = {
    ast.Lt: ("<", ("<=", ">=")),
    ast.LtE: ("<=", ("<", ">")),
    ast.Gt: (">", (">=", "<=")),
    ast.GtE: (">=", (">", "<")),
    ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==",)),
    ast.In: ("in", ("not in",)),
    ast.NotIn: ("not in", ("in",)),
    ast.Is: ("is", ("is not",)),
    ast.IsNot: ("is not", ("is",)),
    ast.And: ("and", ("or",)),
    ast.Or: ("or", ("and",)),
    ast.Add: ("+", ("-",)),
    ast.Sub: ("-", ("+",)),
    ast.Mult: ("*", ("/",)),
    ast.Div: ("/", ("*",)),
    ast.FloorDiv: ("//", ("*",)),
    ast.Mod: ("%", ("*",)),
    ast.Pow: ("**", ("*",)),
    ast.BitAnd: ("&", ("|",)),
    ast.BitOr: ("|", ("&",)),
}
"""Operators between two operands, and what stands in their place."""

SWAPPED = {"min": "max", "max": "min", "any": "all", "all": "any"}
"""Functions whose name is replaced by another."""

TEXT = (ast.JoinedStr, ast.Import, ast.ImportFrom)
"""What holds nothing to change: texts for people, and imports."""

SHOWN = ("print", "warn", "debug", "info", "warning", "error")
"""Calls that show a message; they are left alone."""


@dataclass(frozen=True)
class Change:
    """One line before and after, without its indentation, and the function that it stands in ("" for none)."""

    line: int
    operator: str
    """The kind of syntax node that is changed."""

    function: str
    before: str
    after: str
    statement: int
    """The line where the statement starts, before which another one can be put."""


def changes(source: str) -> list[Change]:
    """Return all single-line changes of a module, in the order of its lines."""
    lines = source.splitlines()
    found = []
    for node, function, statement in _nodes(ast.parse(source), "", 1):
        number = getattr(node, "lineno", 0)
        line = lines[number - 1]
        if number != getattr(node, "end_lineno", 0) or not line.isascii():
            continue
        for start, end, new in _edits(node, line):
            after = line[:start] + new + line[end:]
            found.append(Change(number, type(node).__name__, function, line.strip(), after.strip(), statement))
    return sorted(set(found), key=lambda change: (change.line, change.after))


def replaced(source: str, change: Change) -> str:
    """Return the module with the change in its line."""
    lines = source.splitlines()
    lines[change.line - 1] = lines[change.line - 1].replace(change.before, change.after)
    return "\n".join([*lines, ""])


def parses(source: str) -> bool:
    """Return whether this is Python."""
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


def _nodes(node: ast.AST, function: str, statement: int) -> Iterator[tuple[ast.AST, str, int]]:
    """All nodes below one that can be changed, with the function and the line of the statement that they stand in."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "type_comment"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, TEXT) or _is_typing(child):
                continue
            inner, start = function, statement
            if isinstance(child, ast.stmt) and not _is_elif(node, child):
                decorators = getattr(child, "decorator_list", [])
                start = min([child.lineno, *(decorator.lineno for decorator in decorators)])
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                inner = f"{function}.{child.name}".lstrip(".")
            if hasattr(child, "lineno"):
                yield child, inner, start
            if not isinstance(child, ast.Raise):
                yield from _nodes(child, inner, start)


def _is_elif(parent: ast.AST, child: ast.stmt) -> bool:
    return (
        isinstance(parent, ast.If)
        and isinstance(child, ast.If)
        and parent.orelse == [child]
        and child.col_offset == parent.col_offset
    )


def _is_typing(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def _edits(node: ast.AST, line: str) -> Iterator[tuple[int, int, str]]:
    """Yield columns of a line, from and to, and the text for their place."""
    whole = (getattr(node, "col_offset", 0), getattr(node, "end_col_offset", 0))
    match node:
        case ast.Compare(left=left, ops=ops, comparators=others):
            for one, operator, other in zip([left, *others], ops, others, strict=False):
                yield from _between(one, operator, other, line)
        case ast.BoolOp(op=operator, values=values):
            for one, other in pairwise(values):
                yield from _between(one, operator, other, line)
        case ast.BinOp(left=one, op=operator, right=other):
            yield from _between(one, operator, other, line)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield whole[0], operand.col_offset, ""
        case ast.UnaryOp(op=ast.Invert() | ast.USub(), operand=operand):
            yield whole[0], operand.col_offset, ""
        case ast.Constant(value=bool() as value):
            yield *whole, str(not value)
        case ast.Constant(value=int() | float() as value):
            yield *whole, str(value + 1)
            yield *whole, str(value - 1)
        case ast.Call(func=ast.Name(id=name)) if name in SWAPPED:
            yield whole[0], whole[0] + len(name), SWAPPED[name]
        case ast.Call(func=ast.Attribute(attr=name, end_col_offset=int() as end)) if name in SWAPPED:
            yield end - len(name), end, SWAPPED[name]
        case ast.Return(value=ast.AST() as value) if not _is_none(value):
            yield *whole, "return None"
        case ast.Continue() | ast.Break() | ast.Raise() | ast.AugAssign() | ast.Delete():
            yield *whole, "pass"
        case ast.Expr(value=ast.Call(func=called)) if _name(called) not in SHOWN:
            yield *whole, "pass"
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript(), *_]):
            yield *whole, "pass"
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            if test.lineno == test.end_lineno and not isinstance(test, ast.Compare | ast.BoolOp | ast.UnaryOp):
                yield test.col_offset, test.end_col_offset or 0, f"not ({line[test.col_offset : test.end_col_offset]})"


def _between(one: ast.expr, operator: ast.AST, other: ast.expr, line: str) -> Iterator[tuple[int, int, str]]:
    text, new = FLIPPED.get(type(operator), ("", ()))
    start = one.end_col_offset or 0
    found = re.search(re.escape(text).replace(r"\ ", r"\s+"), line[start : other.col_offset])
    if text and found:
        for replacement in new:
            yield start + found.start(), start + found.end(), replacement


def _is_none(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def _name(called: ast.expr) -> str:
    return called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
