"""Pipes and devices where files are expected: nobody waits for what never comes, and nothing endless is read."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.source import open_dataset

BESIDE = ["{stem}_RPC.TXT", "{stem}_rpc.txt", "{stem}.RPB", "{stem}.IMD", "{stem}.pvl", "{stem}_metadata.txt",
          "{stem}_survey.txt", "DIM_{stem}.XML", "RPC_{stem}.XML", "{stem}.tif.aux.xml", "{stem}.tif.ovr",
          "{stem}.tif.msk", "{stem}.tfw", "{stem}_MET.TXT", "{stem}_RPC_ORG.TXT", "product_met.txt"]  # fmt: skip

INFO = """
import sys
from pathlib import Path
from click.testing import CliRunner
from ortho_pipeline.cli.program import cli
for name in sys.argv[2:]:
    pipe = Path(sys.argv[1]).with_name(name)
    import os
    os.mkfifo(pipe)
    print(name, flush=True)
    done = CliRunner().invoke(cli, ["info", sys.argv[1]])
    assert done.exit_code in (0, 2), (name, done.output)
    pipe.unlink()
"""


@pytest.mark.parametrize("stem", ["IMG_PHR1A_P_001", "po_39001_pan_0000000"])
def test_pipes_beside_an_image_do_not_hang_anything(tiny, tmp_path, stem):
    image = tmp_path / f"{stem}.tif"
    image.write_bytes(tiny.image.read_bytes())
    names = [name.format(stem=stem.removeprefix("IMG_") if name.startswith(("DIM_", "RPC_")) else stem)
             for name in BESIDE]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", INFO, str(image), *names], check=False, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stdout + done.stderr


RECTIFY = """
import json, sys
from click.testing import CliRunner
from ortho_pipeline.cli.program import cli
for words in json.loads(sys.argv[1]):
    done = CliRunner().invoke(cli, ["rectify", *words])
    assert done.exit_code == 2, (words, done.output)
    assert "Remedy:" in done.stderr, (words, done.stderr)
    print(words[-2:], flush=True)
"""


@pytest.mark.parametrize(("name", "refused"), [("{stem}.special", True), ("readme.special", False), ("a.prj", True)])
def test_a_pipe_with_the_name_of_an_image_or_of_metadata_is_refused(tiny, name, refused):
    os.mkfifo(tiny.folder / name.format(stem=tiny.image.stem))
    if not refused:
        open_dataset(tiny.image)
        return
    with pytest.raises(InputError, match="a pipe or a device is in the place of this image's metadata"):
        open_dataset(tiny.image)


def test_endless_files_are_refused(tiny, tmp_path):
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    lines = [
        [
            str(tiny.image),
            "-o",
            str(tmp_path / "out"),
            *(() if option == "--dem" else ("--height", "500")),
            option,
            file,
        ]
        for option, file in (("--gcps", "/dev/zero"), ("--gcps", str(pipe)), ("--rpc", str(pipe)), ("--dem", str(pipe)))
    ]
    command = [sys.executable, "-c", RECTIFY, json.dumps(lines)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not Path(tmp_path / "out").exists()
