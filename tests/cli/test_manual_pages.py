"""Manual pages, and the completion of shells that docs/install.md describes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import make_man
import pytest

ROOT = Path(__file__).resolve().parent.parent.parent


def test_every_command_has_a_manual_page(tmp_path):
    (tmp_path / "ortho-gone.1").write_text("a page of a command that is no more")
    make_man.main(tmp_path)
    words = [context.command_path for context in make_man.contexts()]
    assert {"ortho", "ortho rectify", "ortho cache list", "ortho simulate bilsat"} <= set(words)
    assert {path.name for path in tmp_path.iterdir()} == {f"{one.replace(' ', '-')}.1" for one in words}
    text = (tmp_path / "ortho-rectify.1").read_text(encoding="utf-8")
    assert "\northo rectify scene.tif \\-\\-gcps gcps.geojson \\-\\-dem dem.tif \\-o out\n" in text
    assert "\n.B \\-\\-visibility" in text
    if (groff := shutil.which("groff")) is None:
        pytest.skip("no groff on this machine: what the pages look like was not tried")
    done = subprocess.run(
        [groff, "-man", "-ww", "-Tutf8", *sorted(tmp_path.glob("*.1"))], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    shown = re.sub(r"\x1b\[\d*m|.\x08", "", done.stdout)
    assert "Reserve every third point as a check point:" in shown


ASK = {
    "bash": "COMP_WORDS=({words}); COMP_CWORD={at}; _ortho_completion ortho; printf '%s\\n' \"${{COMPREPLY[@]}}\"",
    "zsh": 'COMP_WORDS="{words}" COMP_CWORD={at} _ORTHO_COMPLETE=zsh_complete ortho',
    "fish": "complete -C '{words}'",
}


@pytest.mark.parametrize("shell", ASK)
def test_shells_complete(shell, tmp_path):
    """The line of docs/install.md, and then what a shell asks when somebody presses the tabulator."""
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} on this machine")
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    (line,) = re.findall(rf"^(.*?) +# {shell}: ", page, re.MULTILINE)
    program = tmp_path / "ortho"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m ortho_pipeline "$@"\n')
    program.chmod(0o755)
    before = "autoload -Uz compinit; compinit -u -D\n" if shell == "zsh" else ""
    script = [before + line]
    script += [ASK[shell].format(words=words, at=words.count(" ")) for words in ("ortho rect", "ortho fit --sig")]
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "HOME": str(tmp_path)}
    done = subprocess.run(
        [shell, "-c", "\n".join(script)], capture_output=True, text=True, check=False, env=environment, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert "rectify" in done.stdout
    assert "--significance" in done.stdout
