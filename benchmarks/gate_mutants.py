"""Mutation testing of the safety gate: how many small defects its tests notice.

    python benchmarks/gate_mutants.py [--only judgement] [--after LINE] [--list]

Each mutant changes one operator, constant, condition, state or act, or leaves a statement out, in
gate.py, judgement.py, latest.py, readback.py or agreement.py, and runs the gate's tests until the
first fails. Prints the survivors, which a person must judge; exit code 1 below 98 % killed.
"""

import argparse
import ast
import copy
import importlib
import importlib.abc
import importlib.util
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MODULES = ("judgement", "gate", "latest", "readback", "agreement")
TESTS = ("judgement", "readback", "agreement", "", "limits", "stuck")
FIRST = {"gate": "", "readback": "readback", "agreement": "agreement"}
WANTED = 0.98
TIMEOUT = 120  # s; a mutant that hangs is noticed
# Everything that the tests need and that is not mutated, loaded once.
PRELOAD = (
    "numpy",
    "scipy.signal",
    "scipy.fft",
    "hypothesis.stateful",
    "pytest",
    "samii_rig.rig.load",
    "samii_rig.model.loops",
    "samii_rig.model.tmm",
    "samii_rig.record.reader",
    "samii_rig.record.writer",
    "samii_rig.signal.estimate",
)
COMPARE = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
BINARY = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}
MEMBERS = {
    "SAFE": "ARMED",
    "ARMED": "RUNNING",
    "RUNNING": "ARMED",
    "FAULT": "SAFE",
    "NOTHING": "ZERO",
    "CONFIGURE": "NOTHING",
    "WRITE": "NOTHING",
    "ZERO": "NOTHING",
}


def bodies(tree: ast.Module) -> Iterator[ast.AST]:
    """The nodes inside functions, without docstrings and annotations."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                yield from inside(statement)


def inside(node: ast.AST) -> Iterator[ast.AST]:
    if isinstance(node, ast.FunctionDef):
        return  # found by itself
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    if isinstance(node, ast.JoinedStr):
        return  # words for a person
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return  # of a zip: an assertion that its parts are equally long, as they are made to be
    yield node
    for name, child in ast.iter_fields(node):
        if name in ("annotation", "returns", "msg"):
            continue
        for one in child if isinstance(child, list) else [child]:
            if isinstance(one, ast.AST):
                yield from inside(one)


def changes(node: ast.AST) -> Iterator[tuple[str, object]]:
    """What can be changed in place: a description and the attribute values to set."""
    match node:
        case ast.Compare(ops=[op]) if type(op) in COMPARE:
            yield (
                f"{type(op).__name__} -> {COMPARE[type(op)].__name__}",
                {"ops": [COMPARE[type(op)]()]},
            )
        case ast.BinOp(op=op) if type(op) in BINARY:
            yield f"{type(op).__name__} -> {BINARY[type(op)].__name__}", {"op": BINARY[type(op)]()}
        case ast.BoolOp(op=op):
            other = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield f"{type(op).__name__} -> {type(other).__name__}", {"op": other}
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield "not left out", {"operand": ast.UnaryOp(ast.Not(), operand)}
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            yield "minus left out", {"op": ast.UAdd()}
        case ast.Constant(value=bool(value)):
            yield f"{value} -> {not value}", {"value": not value}
        case ast.Constant(value=int() | float() as value):
            yield f"{value} -> {value + 1}", {"value": value + 1}
        case ast.Name(id=name) if name in NAMES and isinstance(node.ctx, ast.Load):
            yield f"{name} -> {NAMES[name]}", {"id": NAMES[name]}
        case ast.Attribute(attr=name, value=ast.Name(id="State" | "Act")):
            yield f"{name} -> {MEMBERS[name]}", {"attr": MEMBERS[name]}
        case ast.Attribute(attr=name) if name in NAMES:
            yield f"{name} -> {NAMES[name]}", {"attr": NAMES[name]}
        case ast.If(test=test):
            yield "if: never", {"test": ast.Constant(False)}
            yield "if: always", {"test": ast.Constant(True)}
        case ast.IfExp(test=test):
            yield "choice turned", {"test": ast.UnaryOp(ast.Not(), test)}
        case ast.Expr(value=ast.Call()):
            yield "call left out", {"value": ast.Constant(None)}
        case ast.Assign(targets=[ast.Attribute()]):
            yield "assignment left out", {"targets": [ast.Name("_", ast.Store())]}
        case ast.Raise(exc=ast.expr()):
            yield "raise left out", None


def mutants(source: str) -> Iterator[tuple[int, str, ast.Module]]:
    """Line, description and tree of each."""
    tree = ast.parse(source)
    for number, node in enumerate(bodies(tree)):
        for what, values in changes(node):
            changed = copy.deepcopy(tree)
            target = next(n for i, n in enumerate(bodies(changed)) if i == number)
            if values is None:
                for parent in ast.walk(changed):
                    for body in (getattr(parent, "body", []), getattr(parent, "orelse", [])):
                        if isinstance(body, list) and target in body:
                            body[body.index(target)] = ast.Pass()
            else:
                for name, value in values.items():
                    setattr(target, name, value)
            yield node.lineno, what, ast.fix_missing_locations(changed)


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module from a changed tree."""

    def __init__(self, name: str, tree: ast.Module, path: Path) -> None:
        self.name, self.tree, self.path = name, tree, path

    def find_spec(self, fullname, path, target=None):
        if fullname == self.name:
            return importlib.util.spec_from_loader(fullname, self, origin=str(self.path))
        return None

    def exec_module(self, module) -> None:
        exec(compile(self.tree, str(self.path), "exec"), module.__dict__)


def survives(name: str, tree: ast.Module, path: Path) -> bool:
    """Whether the gate's tests pass with this module; in a process of its own."""
    child = os.fork()
    if child == 0:
        signal.alarm(TIMEOUT)
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        import pytest

        sys.meta_path.insert(0, Changed(name, tree, path))
        # Most fall to the first file alone, which is soon collected.
        own = FIRST.get(name.rpartition(".")[2], TESTS[0])
        files = {t: str(ROOT / "tests" / f"test_gate{'_' * bool(t)}{t}.py") for t in TESTS}
        first = files.pop(own)
        options = ["-x", "-q", "-p", "no:cacheprovider", "--rootdir", str(ROOT)]
        # Loaded before pytest could rewrite its assertions: that is what saves the time.
        options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
        os._exit(int(pytest.main([*options, first]) or pytest.main([*options, *files.values()])))
    _, status = os.waitpid(child, 0)
    return status == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=MODULES)
    parser.add_argument("--after", type=int, default=0, help="line of the module to go on after")
    parser.add_argument("--list", action="store_true", help="say the mutants and end")
    chosen = parser.parse_args()
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT / "tests"))
    for name in PRELOAD:
        importlib.import_module(name)
    start, total, alive = time.monotonic(), 0, []
    for module in (chosen.only,) if chosen.only else MODULES:
        path = ROOT / "samii_rig" / "run" / f"{module}.py"
        source = path.read_text()
        lines = source.splitlines()
        if not survives(f"samii_rig.run.{module}", ast.parse(source), path):
            sys.exit(f"{module}.py as it is fails its tests: no mutant can be judged")
        for line, what, tree in mutants(source):
            if line <= chosen.after:
                continue
            total += 1
            place = f"{module}.py:{line} {what}: {lines[line - 1].strip()}"
            if chosen.list:
                print(place)
            elif survives(f"samii_rig.run.{module}", tree, path):
                alive.append(place)
                print(f"SURVIVED {place}", flush=True)
            elif total % 50 == 0:
                print(f"{total} done", flush=True)
    if chosen.list:
        print(total)
        return 0
    killed = total - len(alive)
    took = time.monotonic() - start
    print(f"{killed} of {total} killed, {killed / total:.1%}, in {took:.0f} s")
    return 0 if killed >= WANTED * total else 1


if __name__ == "__main__":
    sys.exit(main())
