"""The set-up says what it installs before it does; all but GDAL's bindings has pinned versions and hashes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CONSTRAINTS = (ROOT / "tools" / "constraints.txt").read_text(encoding="utf-8")


def set_up(folder: Path, *, user: int = 0, **settings: str) -> str:
    """Run the set-up on a machine that has an interpreter without the module venv, and nothing of GDAL.

    Programs that change the machine only say that they were called.
    """
    programs = folder / "programs"
    programs.mkdir()
    for name in ("bash", "env", "sed", "cat"):
        (programs / name).symlink_to(shutil.which(name))
    stubs = {
        "id": f"echo {user}",
        "python3": 'case "$*" in *ensurepip* | *sysconfig*) exit 1;; *--version*) echo Python 3.13.0;; esac',
        "apt-get": 'echo "CALLED apt-get $*" >&2',
        "sudo": 'echo "CALLED sudo $*" >&2',
    }
    for name, script in stubs.items():
        (programs / name).write_text(f"#!{shutil.which('sh')}\n{script}\n")
        (programs / name).chmod(0o755)
    environment = {"PATH": str(programs), "HOME": str(folder), "VENV": str(folder / "venv"), **settings}
    done = subprocess.run(
        [programs / "bash", ROOT / "tools" / "setup.sh"], cwd=ROOT, env=environment, text=True, check=False,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert done.returncode == 1  # apt-get was no help: there is still no venv
    assert "FAILED: the module venv" in done.stdout
    return done.stdout


@pytest.mark.parametrize(("user", "caller"), [(0, "apt-get"), (1000, "sudo")])
def test_the_packages_of_the_system_are_announced_before_they_are_installed(tmp_path: Path, user: int, caller: str):
    said = set_up(tmp_path, user=user)
    announced, called = said.split(f"CALLED {caller} ", 1) if user == 0 else said.split("CALLED sudo -n apt-get ", 1)
    installed = re.findall(r"apt-get install -y -qq --no-install-recommends (.*)", called)
    assert "libgdal-dev" in " ".join(installed)
    for package in " ".join(installed).split():
        assert re.search(rf"{re.escape(package)}: \w+", announced), package
    assert "APT=no forbids this" in announced


@pytest.mark.parametrize("user", [0, 1000])
def test_apt_can_be_forbidden_and_the_command_is_named(tmp_path: Path, user: int):
    said = set_up(tmp_path, user=user, APT="no")
    assert "CALLED" not in said
    assert f"{'sudo ' if user else ''}apt-get install python3-venv libgdal-dev" in said


def pinned() -> dict[str, list[Requirement]]:
    """Return the constraints by the name of their package; each has hashes."""
    entries = re.findall(
        r"^(\S.*?) \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", CONSTRAINTS, flags=re.MULTILINE
    )
    found: dict[str, list[Requirement]] = {}
    for text, _ in entries:
        found.setdefault(canonicalize_name(Requirement(text).name), []).append(Requirement(text))
    return found


@pytest.mark.parametrize("python", ["3.11.2", "3.12.0", "3.13.0", "3.14.0"])
def test_all_requirements_are_pinned_for_every_interpreter(python: str):
    constraints = pinned()
    surroundings = {"python_version": python.rpartition(".")[0], "python_full_version": python, "sys_platform": "linux"}
    extras = [text for texts in PROJECT["optional-dependencies"].values() for text in texts]
    for wanted in map(Requirement, [*PROJECT["dependencies"], *extras, "hatchling", "pip", "setuptools", "wheel"]):
        if wanted.marker is None or wanted.marker.evaluate(surroundings):
            (pin,) = [
                pin for pin in constraints[canonicalize_name(wanted.name)]
                if pin.marker is None or pin.marker.evaluate(surroundings)
            ]  # fmt: skip
            (version,) = pin.specifier
            assert version.operator == "=="
            assert wanted.specifier.contains(version.version), (wanted, pin)


def test_the_constraints_name_no_place_that_packages_come_from():
    lines = [line for line in CONSTRAINTS.splitlines() if line and not line.lstrip().startswith("#")]
    assert len(lines) > 1000
    assert all(re.fullmatch(r"\S+==\S+( ; .+)? \\|    --hash=sha256:[0-9a-f]{64}( \\)?", line) for line in lines)
    assert "://" not in CONSTRAINTS


def test_the_base_image_is_pinned_by_one_command(tmp_path: Path):
    """Docker is a stub here: it answers what `imagetools inspect` prints for an index of images."""
    digest = "sha256:" + "0123456789abcdef" * 4
    (tmp_path / "docker").write_text(
        f'#!/bin/sh\n[ "$2 $3 $4" = "imagetools inspect python:3.13-slim" ] && echo {digest}\n'
    )
    (tmp_path / "docker").chmod(0o755)
    for name in ("Makefile", "Dockerfile"):
        shutil.copy(ROOT / name, tmp_path)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    for _ in range(2):  # a new digest takes the place of the old one
        subprocess.run(["make", "pin-image"], cwd=tmp_path, env=environment, check=True, capture_output=True)
        text = (tmp_path / "Dockerfile").read_text(encoding="utf-8")
        assert text.count("sha256") == 1
        assert f"\nARG BASE=python:3.13-slim@{digest}\n" in text
    assert len(re.findall(r"^FROM \$\{BASE\}", text, flags=re.MULTILINE)) == len(
        re.findall("^FROM ", text, flags=re.MULTILINE)
    )
