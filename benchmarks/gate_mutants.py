"""Mutation testing of the safety gate: how many small defects its tests notice.

    python benchmarks/gate_mutants.py [--only judgement] [--after LINE] [--sample N] [--list]

Each mutant changes one operator, constant, condition, state or act, or leaves a statement out, in
gate.py, judgement.py, lane.py, latest.py, readback.py or agreement.py, and runs the gate's tests
until the first fails. Prints the survivors, which a person must judge; exit code 1 below 98 %
killed.
"""

import argparse
import ast
import copy
import importlib
import inspect
import math
import os
import random
import resource
import signal
import sys
import time
import types
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parent.parent
MODULES = ("judgement", "gate", "lane", "latest", "readback", "agreement")
TESTS = ("judgement", "reference", "readback", "agreement", "several", "", "limits", "stuck")
WANTED = 0.98
FIRST = {  # "" is tests/safety/test_gate.py
    "judgement": ("judgement", "reference"),
    "gate": ("several", ""),
    "lane": ("several", ""),
    "latest": ("judgement",),
    "readback": ("readback",),
    "agreement": ("agreement",),
}
SLOW = 0.1  # s of CPU; tests beyond come last
HANGS, WAITS = 90, 1800  # s of CPU and of time; a mutant that hangs is noticed
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
Mutant = tuple[str, str, Callable[[], ast.Module]]  # module, place, maker of the tree


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


def changes(node: ast.AST) -> Iterator[tuple[str, dict[str, object] | None]]:
    """What can be changed in place: a description and the attribute values to set, None to leave
    the statement out."""
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


def mutants(source: str) -> Iterator[tuple[int, str, Callable[[], ast.Module]]]:
    """Line, description and maker of each."""
    tree = ast.parse(source)
    for number, node in enumerate(bodies(tree)):
        for what, values in changes(node):
            yield node.lineno, what, partial(mutant, tree, number, values)


def mutant(tree: ast.Module, number: int, values: dict[str, object] | None) -> ast.Module:
    """A copy of the tree with one node changed, or left out."""
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
    return ast.fix_missing_locations(changed)


def codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """The code of a module's functions, whatever they stand in."""
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield constant
            yield from codes(constant)


def functions(module: types.ModuleType) -> Iterator[types.FunctionType]:
    """A module's functions and methods, as they were before they were decorated."""
    own = [x for x in vars(module).values() if getattr(x, "__module__", "") == module.__name__]
    for thing in own:
        for one in vars(thing).values() if isinstance(thing, type) else [thing]:
            bare = one.fget if isinstance(one, property) else getattr(one, "__func__", one)
            if isinstance(bare, types.FunctionType):
                yield inspect.unwrap(bare)


def change(module: types.ModuleType, tree: ast.Module) -> None:
    """Put the changed code into the functions that everybody already holds."""
    found = {c.co_qualname: c for c in codes(compile(tree, str(module.__file__), "exec"))}
    for function in functions(module):
        if function.__code__.co_qualname in found:
            function.__code__ = found[function.__code__.co_qualname]


def file(test: str) -> Path:
    return ROOT / "tests" / "safety" / f"test_gate{'_' * bool(test)}{test}.py"


def passes(session: pytest.Session, item: pytest.Item) -> bool:
    session.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
    return not session.testsfailed


def survives(
    module: types.ModuleType, tree: ast.Module, session: pytest.Session, items: list[pytest.Item]
) -> bool:
    """Whether the gate's tests pass with this module; in a process of its own."""
    child = os.fork()
    if child == 0:
        # On a loaded machine only the processor's time tells a mutant that hangs.
        resource.setrlimit(resource.RLIMIT_CPU, (HANGS, HANGS))
        signal.alarm(WAITS)
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        change(module, tree)
        os._exit(0 if all(passes(session, item) for item in items) else 1)
    _, status = os.waitpid(child, 0)
    return status == 0


class Mutation:
    """A plugin that runs the collected tests once as they are and then for each mutant."""

    def __init__(self, chosen: list[Mutant]) -> None:
        self.chosen, self.alive, self.done = chosen, 0, 0

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        took = {}
        for item in session.items:
            start = time.process_time()
            if not passes(session, item):
                pytest.exit(f"{item.nodeid} fails as it is: no mutant can be judged", 1)
            took[item] = time.process_time() - start
        orders: dict[str, list[pytest.Item]] = {}
        for name, place, make in self.chosen:
            module = importlib.import_module(f"samii_rig.safety.{name}")
            if name not in orders:
                own = {file(test) for test in FIRST[name]}
                # Most mutants fall to a fast test of their own files.
                orders[name] = sorted(
                    took, key=lambda i: (took[i] > SLOW, i.path not in own, took[i])
                )
                if not survives(module, ast.parse(source(name)), session, orders[name]):
                    pytest.exit(
                        f"{name}.py as it is fails in this order: no mutant can be judged", 1
                    )
            self.done += 1
            if survives(module, make(), session, orders[name]):
                self.alive += 1
                print(f"\nSURVIVED {place}", flush=True)
            if self.done % 25 == 0:
                print(f"\n{self.done - self.alive} of {self.done} killed", flush=True)
        return True


def source(name: str) -> str:
    return (ROOT / "samii_rig" / "safety" / f"{name}.py").read_text()


def every(name: str, after: int) -> Iterator[Mutant]:
    """The mutants of a module, each with a word for where and what it is."""
    lines = source(name).splitlines()
    for line, what, make in mutants(source(name)):
        if line > after:
            yield name, f"{name}.py:{line} {what}: {lines[line - 1].strip()}", make


def wilson(k: int, n: int) -> tuple[float, float]:
    """The 95 % interval of a share of which k of n drawn at random are."""
    z = 1.96
    centre, half = k + z * z / 2, z * math.sqrt(k * (n - k) / n + z * z / 4)
    return (centre - half) / (n + z * z), (centre + half) / (n + z * z)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=MODULES)
    parser.add_argument("--after", type=int, default=0, help="line of the module to go on after")
    parser.add_argument("--sample", type=int, help="take so many of them, drawn at random")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--list", action="store_true", help="say the mutants and end")
    asked = parser.parse_args()
    os.chdir(ROOT)
    chosen = [m for n in MODULES if asked.only in (None, n) for m in every(n, asked.after)]
    if asked.sample:
        chosen = random.Random(asked.seed).sample(chosen, min(asked.sample, len(chosen)))
    if asked.list:
        print(*(place for _, place, _ in chosen), sep="\n")
        return 0
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    # The same examples for every mutant; a failure is enough, the smallest one is not looked for.
    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    hypothesis.settings.register_profile(
        "mutants", derandomize=True, database=None, phases=phases, deadline=None
    )
    hypothesis.settings.load_profile("mutants")
    mutation, start = Mutation(chosen), time.monotonic()
    files = [str(file(test)) for test in TESTS]
    if pytest.main(["-q", "-s", "-p", "no:cacheprovider", *files], plugins=[mutation]):
        return 2
    killed, n = mutation.done - mutation.alive, mutation.done
    share, (low, high) = killed / n, wilson(killed, n)
    took = time.monotonic() - start
    print(f"{killed} of {n} killed, {share:.1%} ({low:.1%} to {high:.1%} of all), in {took:.0f} s")
    return 0 if share >= WANTED else 1


if __name__ == "__main__":
    sys.exit(main())
