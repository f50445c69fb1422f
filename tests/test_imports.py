"""The direction of imports, read from the source: the core runs one way, the rest meets it in commands."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

import foajax

PACKAGE = Path(__file__).resolve().parent.parent / "foajax"

# The core, inner to outer. A module imports what is further in; the pure parts may also share pieces.
CORE = [
    ("types", "config"),
    (
        "convolution",
        "foveation",
        "frames",
        "gaze",
        "logpolar",
        "losses",
        "networks",
        "optimizer",
        "patches",
        "recurrence",
        "returns",
        "sharding",
        "winograd",
    ),
    ("agent",),
    ("learner",),
    ("programs",),  # the two compiled programs, made in one place
]
PARTS = 1  # the row of the pure parts
# The outside world knows types, config and itself, never the core.
WORLD = {
    "allocator",
    "checkpoint",
    "cli",
    "compose",
    "coordinator",
    "display",
    "distributed",
    "durable",
    "envs",
    "gymnasium_env",
    "jax_envs",
    "logger",
    "probes",
    "rundir",
    "seek",
    "status",
    "sweep",
    "watchdog",
}
# Where the two meet: the loop that acts, and the commands around a trained agent.
MEETING = {
    "cost",
    "curves",
    "demo",
    "drawing",
    "dump",
    "evaluate",
    "export",
    "heatmap",
    "painting",
    "player",
    "profiling",
    "recording",
    "render",
    "report",
    "rollout",
    "scene",
    "scores",
    "show",
    "snapshots",
    "store",
    "train",
    "wrapper",
}

# What only some may import, so that an engine or a library can be replaced in one place.
ONLY_IN = {
    "envpool": {"envs"},
    "ale_py": {"envs"},
    "gymnasium": {"envs", "gymnasium_env", "wrapper"},
    "flax": {"networks"},
    "optax": {"learner", "optimizer"},
    "orbax": {"checkpoint"},
    "hydra": {"compose"},
    "omegaconf": {"compose"},
    "safetensors": {"dump", "store"},
    "tensorboardX": {"logger"},
}


def imports(name):
    """The modules of foajax and the other packages that a module imports, anywhere in its text."""
    ours, others = set(), set()
    for node in ast.walk(ast.parse((PACKAGE / f"{name}.py").read_text())):
        if isinstance(node, ast.Import):
            dotted = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = "foajax" if node.level else node.module
            base = f"foajax.{node.module}" if node.level and node.module else base
            dotted = [f"foajax.{alias.name}" for alias in node.names] if base == "foajax" else [base]
        else:
            continue
        for path in dotted:
            top, _, rest = path.partition(".")
            (ours if top == "foajax" else others).add(rest.partition(".")[0] if top == "foajax" else top)
    return ours & set(MODULES), others


MODULES = sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__")
OURS = {name: imports(name)[0] for name in MODULES}
OTHERS = {name: imports(name)[1] for name in MODULES}
RANK = {name: rank for rank, row in enumerate(CORE) for name in row}


def test_every_module_has_its_place():
    assert not (set(RANK) & WORLD or set(RANK) & MEETING or WORLD & MEETING)
    assert not set(MODULES) - set(RANK) - WORLD - MEETING  # a new module is placed above


@pytest.mark.parametrize("name", MODULES)
def test_imports_run_one_way(name):
    if name in RANK:
        allowed = {other for other, rank in RANK.items() if rank < RANK[name] or rank == RANK[name] == PARTS}
    elif name in WORLD:
        allowed = WORLD | set(CORE[0])
    else:
        allowed = set(RANK) | WORLD | MEETING - {"train"}
    assert OURS[name] <= allowed


def test_there_is_no_cycle():
    order = list(graphlib.TopologicalSorter(OURS).static_order())
    assert order.index("types") < order.index("agent") < order.index("learner") < order.index("train")


@pytest.mark.parametrize("package", ONLY_IN)
def test_a_replaceable_library_is_imported_in_one_place(package):
    assert {name for name in MODULES if package in OTHERS[name]} <= ONLY_IN[package]


def test_config_needs_the_standard_library_only():
    assert OTHERS["config"] <= sys.stdlib_module_names
    assert OTHERS["types"] <= sys.stdlib_module_names | {"jaxtyping", "numpy"}


@pytest.mark.parametrize("name", [name for name in MODULES if RANK.get(name, len(CORE)) < len(CORE) - 1])
def test_the_core_has_no_side_effects(name):
    tree = ast.parse((PACKAGE / f"{name}.py").read_text())
    called = {node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    attributes = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert "jit" not in attributes  # compiled in `programs` alone
    assert not called & {"print", "open"}
    assert not OTHERS[name] & {"logging", "os", "pathlib", "yaml"}


@pytest.mark.parametrize("name", foajax.__all__)
def test_a_public_name_is_found_on_first_use(name):
    assert getattr(foajax, name).__name__ == name


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="foajax.*nothing"):
        foajax.nothing  # noqa: B018


def test_what_a_command_line_needs_imports_neither_jax_nor_hydra():
    code = "import sys, foajax, foajax.config, foajax.compose as c; c.list_experiments(); print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=PACKAGE.parent
    )
    assert not {"jax", "numpy", "hydra", "omegaconf"} & set(loaded.stdout.split())
