"""What is released: wheel and sdist as an index wants them, and an empty environment of each Python that runs them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml

import foajax

ROOT = Path(__file__).parent.parent
PYTHONS = ("3.11", "3.12", "3.13")


def run(*words, **options):
    result = subprocess.run(list(map(str, words)), capture_output=True, text=True, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The wheel and the sdist of this checkout."""
    directory = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", directory, ROOT)
    return sorted(directory.iterdir(), key=lambda file: file.suffix != ".whl")


def test_one_version_everywhere():
    version = foajax.__version__
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert re.search(r"^## \[(.+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1] == version


def test_every_locked_package_has_a_hash():
    packages = re.split(r"\n(?=\S)", (ROOT / "requirements.lock").read_text())
    assert len(packages) > 100 and all("--hash=sha256:" in package for package in packages)


@pytest.mark.slow
def test_an_index_would_take_both(built):
    pytest.importorskip("twine")
    assert run(sys.executable, "-m", "twine", "check", "--strict", *built).count("PASSED") == 2
    wheel, sdist = built
    named = zipfile.ZipFile(wheel).namelist()
    assert "foajax/experiments/base.yaml" in named and "foajax/viewing/player.html" in named
    assert any(name.startswith("foajax/agents/") and name.endswith("agent.safetensors") for name in named)
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert {"README.md", "LICENSE", "mkdocs.yml", "docs/index.md", "tests/test_release.py"} <= packed


@pytest.mark.slow
@pytest.mark.parametrize("python", PYTHONS)
def test_the_wheel_runs_in_an_empty_environment(python, built, tmp_path):
    found = shutil.which(f"python{python}")
    if found is None or subprocess.run([found, "-c", ""], capture_output=True).returncode:
        pytest.skip(f"Python {python} is not installed")
    run(found, "-m", "venv", tmp_path / "empty")
    inside = tmp_path / "empty" / "bin"
    run(inside / "pip", "install", "--quiet", "--disable-pip-version-check", built[0])
    assert "missing nothing" in " ".join(run(inside / "foajax", "doctor", cwd=tmp_path).split())
    words = ["experiment=seek", "train.env_steps=512", "env.num_envs=4", "run=run"]
    assert "done: " in run(inside / "foajax", "train", *words, cwd=tmp_path)
    assert "Watch it: file://" in run(inside / "foajax", "demo", "steps=3", cwd=tmp_path)
