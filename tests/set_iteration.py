"""Finds code that depends on the order of a set: that order changes from run to run (PYTHONHASHSEED).

What is a set is told by its form (displays, `set(…)`, operators on sets, differences of `keys()`), by annotations
of arguments, variables, attributes and results in the same package, and by assignments within a function. Names of
attributes and functions that also mean something else somewhere are left out: nothing is reported by mistake.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, replace

SETS = frozenset({"set", "frozenset", "Set", "AbstractSet", "MutableSet"})
SET_METHODS = frozenset({"union", "intersection", "difference", "symmetric_difference"})

ORDERLESS = SETS | SET_METHODS | {
    "sorted", "any", "all", "sum", "len", "min", "max", "bool", "isinstance",
    "update", "issubset", "issuperset", "isdisjoint", "difference_update", "intersection_update",
}  # fmt: skip
"""Calls whose result does not depend on the order of an argument, unless they are given a key."""

ORDERED = frozenset({
    "list", "tuple", "iter", "next", "enumerate", "zip", "map", "filter", "reversed", "join", "extend", "chain",
    "from_iterable", "fromkeys", "product", "combinations", "permutations", "pairwise", "reduce", "deque", "islice",
    "str", "repr", "sorted", "min", "max",
})  # fmt: skip
"""Calls whose result depends on it; the last three with a key."""

FOLDERS = frozenset({"listdir", "iterdir", "scandir", "glob", "rglob"})


@dataclass(frozen=True)
class Known:
    """Names that always stand for sets: functions, attributes and types of a package, variables of a function.

    `types` are by module, as in `Ids = frozenset[int]`.
    """

    functions: Set[str]
    attributes: Set[str]
    types: Mapping[str, Set[str]]
    names: Set[str] = frozenset()


def known_sets(sources: Mapping[str, str]) -> Known:
    """What annotations say of the functions and attributes of some modules."""
    functions: dict[str, bool] = {}
    attributes: dict[str, bool] = {}
    trees = {module: ast.parse(source) for module, source in sources.items()}
    types = {module: _own_types(tree) for module, tree in trees.items()}
    for module, tree in trees.items():
        here = _types(module, tree, types)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                table = attributes if _is_property(node) else functions
                table[node.name] = table.get(node.name, True) and _says_set(node.returns, here)
            if isinstance(node, ast.ClassDef):
                for one in node.body:
                    if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
                        _note(attributes, one.target.id, _says_set(one.annotation, here))
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Attribute):
                _note(attributes, node.target.attr, _says_set(node.annotation, here))
            if isinstance(node, ast.Assign):
                for target in node.targets:
                    if isinstance(target, ast.Attribute):
                        _note(attributes, target.attr, isinstance(node.value, ast.Set | ast.SetComp))
    return Known(
        {name for name, always in functions.items() if always},
        {name for name, always in attributes.items() if always},
        types,
    )


def _own_types(tree: ast.Module) -> set[str]:
    """Names that a module gives to types that are sets."""
    return {
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Subscript)
        and _says_set(node.value, SETS)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


def _types(module: str, tree: ast.Module, known: Mapping[str, Set[str]]) -> set[str]:
    """All names of types that are sets in a module: Python's, its own, and those that it imports."""
    imported = {
        one.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for one in node.names
        if one.name in known.get(node.module.removeprefix("powderdsl."), ())
    }
    return {*SETS, *known.get(module, ()), *imported}


def _note(table: dict[str, bool], name: str, is_set: bool) -> None:
    table[name] = table.get(name, True) and is_set


def _is_property(node: ast.FunctionDef) -> bool:
    return any(ast.unparse(one).endswith("property") for one in node.decorator_list)


def _says_set(annotation: ast.expr | None, types: Set[str]) -> bool:
    match annotation:
        case ast.Constant(value=str(text)):
            return _says_set(ast.parse(text, mode="eval").body, types)
        case ast.Subscript(value=value):
            return _says_set(value, types)
        case ast.BinOp(left=left, right=right):  # `frozenset[int] | None`
            return _says_set(left, types) or _says_set(right, types)
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name in types
    return False


def order_faults(module: str, source: str, known: Known) -> Iterator[str]:
    """Where a module iterates over a set, or over a folder, in the order in which they happen to lie."""
    tree = ast.parse(source)
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    yield from _scope(module, tree, known, _types(module, tree, known.types), parents)


def _scope(
    module: str, scope: ast.AST, known: Known, types: Set[str], parents: Mapping[ast.AST, ast.AST]
) -> Iterator[str]:
    """The faults of a function or a module; functions in it know its names."""
    names = set(known.names)
    if isinstance(scope, ast.FunctionDef | ast.Lambda):
        for one in (*scope.args.posonlyargs, *scope.args.args, *scope.args.kwonlyargs):
            (names.add if _says_set(one.annotation, types) else names.discard)(one.arg)
    own = replace(known, names=names)
    body, inner = _own_nodes(scope)
    for _ in range(3):  # one name may come of another
        for node in body:
            match node:
                case (
                    ast.Assign(targets=[ast.Name(id=name)], value=value)
                    | ast.NamedExpr(target=ast.Name(id=name), value=value)
                ) if _is_set(value, own):
                    names.add(name)
                case ast.AnnAssign(target=ast.Name(id=name)) if _says_set(node.annotation, types):
                    names.add(name)
    for node in body:
        for what in _uses(node, own, parents):
            yield f"{module}:{what.lineno} depends on the order of a set or folder: {ast.unparse(what)}"
    seen = known if isinstance(scope, ast.ClassDef) else own  # methods do not see the names of their class
    for one in inner:
        yield from _scope(module, one, seen, types, parents)


def _own_nodes(scope: ast.AST) -> tuple[list[ast.AST], list[ast.AST]]:
    """The nodes of a scope, and the functions and classes that begin in it."""
    body: list[ast.AST] = []
    inner: list[ast.AST] = []
    waiting = list(ast.iter_child_nodes(scope))
    while waiting:
        node = waiting.pop(0)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef):
            inner.append(node)
        else:
            body.append(node)
            waiting.extend(ast.iter_child_nodes(node))
    return body, inner


def _is_set(node: ast.expr, known: Known) -> bool:
    match node:
        case ast.Set() | ast.SetComp():
            return True
        case ast.Name(id=name):
            return name in known.names
        case ast.Attribute(attr=name):
            return name in known.attributes
        case ast.BinOp(left=left, op=ast.BitOr() | ast.BitAnd() | ast.Sub() | ast.BitXor(), right=right):
            return any(_is_set(side, known) or _is_keys(side) for side in (left, right))
        case ast.IfExp(body=yes, orelse=no):
            return _is_set(yes, known) or _is_set(no, known)
        case ast.BoolOp(values=values):
            return any(_is_set(value, known) for value in values)
        case ast.NamedExpr(value=value):
            return _is_set(value, known)
        case ast.Call(func=ast.Name(id=name)):
            return name in SETS or name in known.functions
        case ast.Call(func=ast.Attribute(value=value, attr=name)):
            return name in known.functions or (name in SET_METHODS and _is_set(value, known))
    return False


def _is_keys(node: ast.expr) -> bool:
    """`x.keys()`: what operators make of it is a set."""
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "keys"


def _is_folder(node: ast.expr) -> bool:
    return isinstance(node, ast.Call) and _called(node) in FOLDERS


def _called(node: ast.Call) -> str:
    return node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")


def _uses(node: ast.AST, known: Known, parents: Mapping[ast.AST, ast.AST]) -> Iterator[ast.expr]:
    """What a node goes through in an order that decides something."""

    def loose(value: ast.expr) -> bool:
        return _is_set(value, known) or _is_folder(value)

    match node:
        case ast.For(iter=value) if loose(value):
            yield value
        case ast.ListComp() | ast.GeneratorExp() | ast.DictComp():
            if not _orderless(node, parents):
                yield from (one.iter for one in node.generators if loose(one.iter))
        case ast.Starred(value=value) if loose(value) and not isinstance(parents[node], ast.Set):
            if not _orderless(parents[node], parents) and not _orderless(node, parents):
                yield value
        case ast.Call():
            keyed = any(one.arg == "key" for one in node.keywords)
            if _called(node) in ORDERED and (keyed or _called(node) not in ORDERLESS):
                yield from (one for one in node.args if loose(one))
            if (
                _called(node) == "pop"
                and not node.args
                and isinstance(node.func, ast.Attribute)
                and loose(node.func.value)
            ):
                yield node.func.value
        case ast.FormattedValue(value=value) | ast.YieldFrom(value=value) if loose(value):
            yield value
        case ast.Assign(targets=[ast.Tuple() | ast.List()], value=value) if loose(value):
            yield value


def _orderless(node: ast.AST, parents: Mapping[ast.AST, ast.AST]) -> bool:
    """Whether a value goes into a call that does not mind its order."""
    call = parents.get(node)
    if not isinstance(call, ast.Call) or node not in call.args:
        return False
    return _called(call) in ORDERLESS and all(one.arg != "key" for one in call.keywords)


def all_faults(sources: Mapping[str, str]) -> Iterable[str]:
    """The faults of all modules of a package."""
    known = known_sets(sources)
    for module, source in sources.items():
        yield from order_faults(module, source, known)
