"""The process that expands a xacro file: it runs no code of the file, and its time and memory are bounded.

xacro hands the text of `${...}` to Python. Here a reader of our own takes Python's place: it knows names,
numbers, texts, lists, arithmetic, comparisons, and the functions that xacro documents, and nothing else.
Files are opened only in the folder of the xacro file and in ROS packages; the process has no environment.
`urdf.py` starts this file as a program, and gives it its task as JSON on standard input.
"""

from __future__ import annotations

import ast
import json
import math
import operator
import sys
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from pathlib import Path
from types import ModuleType
from typing import IO, Any

#: Functions of Python that expressions may call, as `len(...)` or `python.len(...)`.
_FUNCTIONS = """abs all any bool dict divmod enumerate float int len list map max min range reversed round set
sorted str sum tuple zip"""
#: Functions of xacro that expressions may call, as `xacro.load_yaml(...)` or `load_yaml(...)`.
_OF_XACRO = "abs_filename arg dotify error fatal load_yaml message print_location tokenize warning"
#: Methods of texts, lists and mappings that expressions may call.
_METHODS = """count endswith find get index items join keys lower lstrip replace rstrip split startswith strip
title upper values"""
#: What an operator of an expression does.
_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow, ast.BitOr: operator.or_,
    ast.BitAnd: operator.and_, ast.BitXor: operator.xor, ast.Invert: operator.invert, ast.Not: operator.not_,
    ast.UAdd: operator.pos, ast.USub: operator.neg, ast.Eq: operator.eq, ast.NotEq: operator.ne,
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
    ast.Is: operator.is_, ast.IsNot: operator.is_not,
    ast.In: lambda item, items: item in items, ast.NotIn: lambda item, items: item not in items,
}  # fmt: skip


class Expressions:
    """Values of the expressions of a xacro file.

    Args:
        xacro: The module. Functions that expressions may not call are taken out of its symbols.
    """

    def __init__(self, xacro: Any) -> None:
        symbols = xacro._global_symbols
        math_names = [name for name in dir(math) if not name.startswith("_")]
        spaces = {"python": _FUNCTIONS.split(), "math": math_names, "xacro": _OF_XACRO.split()}
        allowed = {name: (symbols[name], names) for name, names in spaces.items()}
        allowed[""] = (symbols, [*spaces, *(name for names in spaces.values() for name in names)])
        for table, names in allowed.values():
            for name in set(table) - {*names, "True", "False"}:
                dict.pop(table, name)
        self._functions = [value for table, _ in allowed.values() for value in table.values()]
        self._dotted = (xacro.NameSpace, xacro.YamlDictWrapper)
        self._plain = (str, list, tuple, dict, xacro.YamlListWrapper, xacro.YamlDictWrapper)

    def evaluate(self, text: str, names: Any, _: Any = None) -> Any:
        """The value of an expression.

        Args:
            text: The expression.
            names: Values of its names.

        Raises:
            SyntaxError: It is no expression, or none of the kinds that are allowed.
            NameError: A name has no value.
        """
        return self._value(ast.parse(text.strip(), mode="eval").body, names)

    def _value(self, node: ast.expr, names: Any) -> Any:
        """The value of a part of an expression; each kind of part that is allowed has a case here."""

        def of(part: ast.expr) -> Any:
            return self._value(part, names)

        match node:
            case ast.Constant(value=value) if value is None or isinstance(value, (bool, int, float, str)):
                return value
            case ast.Name(id=name):
                return _looked_up(names, name)
            case ast.Attribute(value=holder, attr=name):
                return self._entry(of(holder), name)
            case ast.UnaryOp(op=op, operand=operand):
                return _OPERATORS[type(op)](of(operand))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](of(left), of(right))
            case ast.BoolOp(op=op, values=parts):
                return self._joined(isinstance(op, ast.Or), parts, names)
            case ast.Compare(left=left, ops=ops, comparators=others):
                values = [of(left), *map(of, others)]
                pairs = zip(ops, values, values[1:], strict=False)
                return all(_OPERATORS[type(op)](one, other) for op, one, other in pairs)
            case ast.IfExp(test=test, body=body, orelse=other):
                return of(body) if of(test) else of(other)
            case ast.List(elts=parts):
                return [of(part) for part in parts]
            case ast.Tuple(elts=parts):
                return tuple(of(part) for part in parts)
            case ast.Dict(keys=keys, values=parts) if None not in keys:
                return {of(key): of(part) for key, part in zip(keys, parts, strict=True) if key is not None}
            case ast.Subscript(value=holder, slice=ast.Slice(lower=low, upper=high, step=step)):
                return of(holder)[slice(*(None if part is None else of(part) for part in (low, high, step)))]
            case ast.Subscript(value=holder, slice=key):
                return of(holder)[of(key)]
            case ast.Call(func=function, args=parts, keywords=more) if all(one.arg for one in more):
                arguments = {str(one.arg): of(one.value) for one in more}
                return self._function(function, names)(*map(of, parts), **arguments)
        raise SyntaxError(f"{ast.unparse(node)!r} is no number, text, list, arithmetic, comparison or call")

    def _joined(self, is_or: bool, parts: list[ast.expr], names: Any) -> Any:
        """The value of `a and b` or `a or b`; what need not be looked at is not."""
        value = None
        for part in parts:
            value = self._value(part, names)
            if bool(value) == is_or:
                break
        return value

    def _function(self, node: ast.expr, names: Any) -> Callable[..., Any]:
        """The function of a call: one of xacro's, or a method of a text, list or mapping."""
        if isinstance(node, ast.Attribute):
            holder = self._value(node.value, names)
            if type(holder) in self._plain and node.attr in _METHODS.split():
                return getattr(holder, node.attr)
            function = self._entry(holder, node.attr)
        else:
            function = self._value(node, names)
        if not callable(function) or not any(function is one for one in self._functions):
            raise SyntaxError(f"{ast.unparse(node)!r} is no function that xacro documents")
        return function

    def _entry(self, holder: Any, name: str) -> Any:
        """`holder.name`: an entry of a namespace or of a mapping from YAML, never an attribute."""
        if not isinstance(holder, self._dotted):
            raise SyntaxError(f"'.{name}' of what is neither a namespace nor a mapping from a YAML file")
        return _looked_up(holder, name)


def _looked_up(names: Any, name: str) -> Any:
    if name.startswith("_"):
        raise SyntaxError(f"{name!r} begins with an underscore")
    try:
        return names[name]
    except (KeyError, AttributeError):
        raise NameError(f"name {name!r} is not defined") from None


def _expanded(task: dict[str, Any]) -> str:
    """The text of a xacro file with its macros expanded.

    Raises:
        Exception: xacro or an expression of the file raises anything.
    """
    from importlib import import_module

    from amhe_cli.core.errors import ConfigError
    from amhe_cli.core.files import check_regular
    from amhe_cli.system.model.packages import Places

    xacro: Any = import_module("xacro")
    folder = Path(task["path"]).parent
    places = Places(folder, folder, task["packages"])
    home = next((above for above in (folder, *folder.parents) if (above / "package.xml").is_file()), folder)
    roots = {place.resolve() for place in (folder, home, *map(Path, task["packages"].values()))}

    def share(name: str) -> str:
        homes = places.homes(name)
        if not homes:
            raise ConfigError(f"no package {name!r} is known: give its folder in `packages`")
        roots.update(place.resolve() for place in homes[:1] if (place / "package.xml").is_file())
        return str(homes[0])

    def opened(name: str) -> IO[str]:
        path = Path(name).resolve()
        if not any(path.is_relative_to(root) for root in roots):
            raise ConfigError(
                f"{path} is neither in the folder of this file nor in a ROS package with a package.xml; give "
                "its package in `packages`"
            )
        check_regular(path)
        return path.open(encoding="utf-8")

    def refused(text: str, *_: Any) -> str:
        raise ConfigError(f"$(eval {text}) would run Python: write ${{{text}}}")

    ours, packages = ModuleType("ament_index_python"), ModuleType("ament_index_python.packages")
    packages.get_package_share_directory = share  # type: ignore[attr-defined]
    sys.modules |= {module.__name__: module for module in (ours, packages)}  # what $(find NAME) asks
    for module in (xacro, import_module("xacro.substitution_args")):
        module.eval = refused  # type: ignore[attr-defined]
    xacro.open = opened
    xacro.safe_eval = Expressions(xacro).evaluate
    return xacro.process_file(task["path"], mappings=task["args"]).toxml()


def _bound(seconds: int, mebibytes: int) -> None:
    """Let the kernel end this process beyond a processor time, 1 GiB of memory, or the size of its output."""
    import resource

    for kind, most in (("CPU", seconds), ("AS", 2**30), ("FSIZE", mebibytes * 2**20)):
        with suppress(ValueError, OSError):  # not every system knows each
            resource.setrlimit(getattr(resource, f"RLIMIT_{kind}"), (most, most))


def main() -> None:
    """Do the task on standard input; the answer goes to standard output as JSON, warnings to stderr."""
    task = json.load(sys.stdin)
    sys.path[:] = task["sys_path"]
    _bound(task["seconds"], task["mebibytes"])
    try:
        with redirect_stdout(sys.stderr):
            answer = {"text": _expanded(task)}
    except Exception as error:
        cause: Any = error
        while getattr(cause, "exc", None):  # xacro's own, with macros and files about the cause
            cause = cause.exc
        answer = {"error": " ".join(str(cause).split()) or repr(cause)}
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
