"""Who may import whom: four rules, read from the source, imports inside of functions and for types included."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ORDER = "config | sensors networks envs | learning | runs | viewing launch | reporting training | robot"
RANK = {package: rank for rank, row in enumerate(ORDER.split("|")) for package in row.split()}
OPEN = {"types": set(), "runtime": set(), "cli": {"config"}}  # to everyone; and what of ours they import themselves
ONLY_IN = {"hydra": {"config", "launch"}, "omegaconf": {"config", "launch"}, "envpool": {"envs"}, "flax": {"networks"}}
FILES = {file.relative_to(ROOT).with_suffix(""): file for file in sorted(ROOT.glob("foajax/**/*.py"))}
TREES = {".".join(path.parts).removesuffix(".__init__"): ast.parse(file.read_text()) for path, file in FILES.items()}
PURE = {name for name in TREES if name.split(".")[1:2] in (["sensors"], ["networks"], ["learning"])}


def imports(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in TREES else node.module for name in inner)


EDGES = {name: set(imports(tree)) for name, tree in TREES.items()}


def place(name):
    """The package of foajax that a module is in, or its own name where it is in none."""
    return name.split(".")[1] if name.startswith("foajax.") else ""


@pytest.mark.parametrize("name", TREES)
def test_a_module_imports_only_what_stands_before_it(name):
    here = place(name)
    rank = RANK.get(here, len(RANK))  # a command may import all packages, and nobody a command
    before = {package for package in RANK if package == here or RANK[package] < rank} | OPEN.keys()
    assert {place(edge) for edge in EDGES[name] if edge.startswith("foajax")} <= OPEN.get(here, before)
    assert all(here in ONLY_IN.get(edge.split(".")[0], {here}) for edge in EDGES[name])


def test_there_is_no_cycle_and_a_command_line_is_read_without_jax():
    tuple(graphlib.TopologicalSorter(EDGES).static_order())
    code = "import sys, foajax.__main__, foajax.runtime, foajax.launch.launch, foajax.config.compose as c\n"
    words = [sys.executable, "-c", code + "c.list_experiments(); print(*sys.modules)"]
    loaded = subprocess.run(words, check=True, capture_output=True, text=True, cwd=ROOT).stdout.split()
    assert not {"jax", "numpy", "hydra", "omegaconf"} & set(loaded)


WITHOUT_JAX = {
    f"foajax.sensors.{name}" for name in ("actions", "eye", "gaze", "geometry", "numpy", "pixels", "wrappers")
}


def test_wrappers_need_no_jax():
    """No module of JAX's at the top of these, nor of what they import; inside of functions there may be."""
    code = f"import sys, {', '.join(sorted(WITHOUT_JAX))}\nprint(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    assert not {"jax", "flax", "envpool"} & set(loaded.stdout.split())


COMPILE = {"foajax.learning.programs", "foajax.sensors.compiled"}


@pytest.mark.parametrize("name", sorted(PURE - COMPILE))
def test_pure_parts_are_compiled_elsewhere_and_have_no_side_effects(name):
    names = {getattr(node, "attr", getattr(node, "id", None)) for node in ast.walk(TREES[name])}
    assert not names & {"jit", "print", "open"} and not EDGES[name] & {"logging", "os", "pathlib", "yaml"}
