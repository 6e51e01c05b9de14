"""Real scenes are fetched whole, by checksum, and into their folder alone; a server of this machine publishes them."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import real_data
from real_data import RealFile, data_folder, main, read_table
from real_seeds import FILES as SEEDS

COMMIT = "0123456789abcdef" * 2 + "01234567"
#: Path below the folder -> path in the repository, and content.
INVENTED = {
    "one/image.tif": ("tests/data/image 1.tif", b"II*\0" + bytes(range(256)) * 40),
    "one/deep/er/rpc.txt": ("rpc.txt", b"LINE_OFF: 12.5\r\n"),
    "two/dem.tif": ("dem.tif", b"heights"),
}
ORIGINS = {"someone/images": ["one/image.tif", "one/deep/er/rpc.txt"], "other/dems": ["two/dem.tif"]}


class Server:
    """Publishes the invented files, and remembers which were asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder, asked = folder, []
        self.asked = asked

        class Handler(SimpleHTTPRequestHandler):
            def log_message(self, format: str, *arguments: object) -> None:
                asked.append(self.path)

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        self.base = f"http://127.0.0.1:{self._http.server_port}"
        threading.Thread(target=partial(self._http.serve_forever, poll_interval=0.01), daemon=True).start()

    def close(self) -> None:
        self._http.shutdown()
        self._http.server_close()

    def place(self, path: str) -> Path:
        """Return the published file of a path below the folder."""
        (origin,) = (name for name, paths in ORIGINS.items() if path in paths)
        return self.folder / origin / COMMIT / INVENTED[path][0]


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    origins = []
    made = Server(tmp_path / "published")
    for origin, paths in ORIGINS.items():
        files = []
        for path in paths:
            source, content = INVENTED[path]
            made.place(path).parent.mkdir(parents=True, exist_ok=True)
            made.place(path).write_bytes(content)
            sha256 = hashlib.sha256(content).hexdigest()
            files.append({"path": path, "source": source, "sha256": sha256, "bytes": len(content)})
        origins.append({"repository": origin, "commit": COMMIT, "licence": "MIT", "files": files})
    table = tmp_path / "table.json"
    table.write_text(json.dumps({"origins": origins}))
    monkeypatch.setattr(real_data, "TABLE", table)
    yield made
    made.close()


def files_in(folder: Path) -> dict[str, bytes]:
    """Return all files, hidden ones as well, with their content."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


WHOLE = {path: content for path, (_, content) in INVENTED.items()}


def test_all_files_come_once_and_a_second_run_asks_for_nothing(server, tmp_path, capsys):
    folder = tmp_path / "data"
    assert main(["--base", server.base, str(folder)]) == 0
    assert files_in(folder) == WHOLE
    assert len(server.asked) == 3
    assert capsys.readouterr().out.splitlines() == [
        "   2 of   2 files: someone/images (MIT)",
        "   1 of   1 files: other/dems (MIT)",
        f"   3 of   3 files are in {folder}",
    ]
    (folder / "one/image.tif").write_bytes(b"cut off")
    (folder / "two/dem.tif").unlink()
    assert main(["--base", server.base + "/", str(folder)]) == 0
    assert files_in(folder) == WHOLE
    assert len(server.asked) == 5
    assert main(["--base", server.base, str(folder)]) == 0
    assert len(server.asked) == 5


@pytest.mark.parametrize("fault", ["other content", "too short", "too long", "missing", "cut off"])
def test_a_file_that_is_not_whole_gets_no_name_and_the_others_come(server, tmp_path, capsys, monkeypatch, fault):
    folder, wrong = tmp_path / "data", server.place("one/image.tif")
    content = wrong.read_bytes()
    if fault == "missing":
        wrong.unlink()
    elif fault == "cut off":
        monkeypatch.setattr(SimpleHTTPRequestHandler, "copyfile", lambda _, source, out: out.write(source.read(5)))
    else:
        wrong.write_bytes(
            {"other content": b"?" + content[1:], "too short": content[:-1], "too long": content + b"?"}[fault]
        )
    assert main(["--base", server.base, str(folder)]) == 1
    expected = {"two/dem.tif": b"heights", "one/deep/er/rpc.txt": WHOLE["one/deep/er/rpc.txt"]}
    assert files_in(folder) == ({} if fault == "cut off" else expected)
    told = capsys.readouterr().err
    assert told.startswith("Error: one/image.tif: ")
    assert f"address: {server.base}/someone/images/{COMMIT}/tests/data/image%201.tif\n" in told
    assert "Run the command again" in told
    # What is right meanwhile is fetched by the next run, and nothing else.
    monkeypatch.undo()
    monkeypatch.setattr(real_data, "TABLE", tmp_path / "table.json")
    wrong.write_bytes(content)
    server.asked.clear()
    assert main(["--base", server.base, str(folder)]) == 0
    assert files_in(folder) == WHOLE
    assert fault == "cut off" or [path.endswith("image%201.tif") for path in server.asked] == [True]


def test_a_server_that_does_not_answer_is_asked_once_for_an_origin(server, tmp_path, capsys):
    server.close()
    assert main(["--base", server.base, str(tmp_path / "data")]) == 1
    told = capsys.readouterr().err
    assert told.count("Error: ") == len(ORIGINS)
    assert "Is this machine online" in told
    assert not (tmp_path / "data").exists()
    assert main(["--base", "no address", str(tmp_path / "data")]) == 1


def test_a_check_names_each_file_that_differs_and_changes_nothing(server, tmp_path, capsys):
    folder = tmp_path / "data"
    assert main(["--base", server.base, str(folder)]) == main(["--check", str(folder)]) == 0
    server.asked.clear()
    (folder / "one/image.tif").write_bytes(b"cut off")
    (folder / "one/deep/er/rpc.txt").unlink()
    before = files_in(folder)
    capsys.readouterr()
    assert main(["--check", "--base", server.base, str(folder)]) == 1
    told = capsys.readouterr().err
    assert all(f"Error: {path}: missing or different" in told for path in ORIGINS["someone/images"])
    assert told.count("Error: ") == 2
    assert files_in(folder) == before
    assert not server.asked


ELSEWHERE = ("../a.tif", "a/../../b", "/etc/a", "//a/b", "", ".", "a\\b")


@pytest.mark.parametrize(
    "change",
    [{name: text} for name in ("path", "source") for text in ELSEWHERE]
    + [{"repository": "a/b/c"}, {"repository": "../b"}, {"repository": "a/.."}, {"commit": "main"}],
)  # fmt: skip
def test_a_table_with_names_that_lead_elsewhere_is_refused(change):
    good = {"path": "a/b", "source": "c", "sha256": "0" * 64, "bytes": 1, "repository": "a/b", "commit": COMMIT}
    RealFile(**good)
    with pytest.raises(ValueError, match=r"is not a path inside a folder|is not OWNER/NAME at a commit"):
        RealFile(**{**good, **change})


def test_nothing_is_written_through_a_link(server, tmp_path, capsys):
    folder, outside = tmp_path / "data", tmp_path / "outside"
    (outside / "deep").mkdir(parents=True)
    (outside / "dem.tif").write_bytes(b"mine")
    folder.mkdir()
    (folder / "one").symlink_to(outside)
    (folder / "two").mkdir()
    (folder / "two" / "dem.tif").symlink_to(outside / "dem.tif")
    assert main(["--base", server.base, str(folder)]) == 1
    assert capsys.readouterr().err.count(f"a link leads out of {folder}") == 2
    assert files_in(outside) == {"dem.tif": b"mine"}
    # The link itself gives way to the file.
    assert (folder / "two" / "dem.tif").read_bytes() == b"heights"


def test_a_folder_that_cannot_be_written_is_an_error_with_a_remedy(server, tmp_path, capsys):
    folder = tmp_path / "data"
    folder.write_bytes(b"a file")
    assert main(["--base", server.base, str(folder)]) == 1
    assert f"Make {folder} writable" in capsys.readouterr().err
    assert folder.read_bytes() == b"a file"


def test_tests_find_the_data(monkeypatch, tmp_path):
    monkeypatch.setenv("ORTHO_REAL_DATA", str(tmp_path))
    assert data_folder() == tmp_path
    monkeypatch.delenv("ORTHO_REAL_DATA")
    monkeypatch.setattr(real_data, "ROOT", tmp_path / "checkout")
    assert data_folder() == real_data.FOLDER
    (tmp_path / "shared" / "data").mkdir(parents=True)
    assert data_folder() == tmp_path / "shared" / "data"


def test_the_table_names_each_file_once_with_its_licence():
    origins = read_table(real_data.TABLE)
    files = [file for some in origins.values() for file in some]
    paths = {file.path for file in files}
    assert len(paths) == len(files)
    assert all(len(bytes.fromhex(file.sha256)) == 32 and 0 < file.bytes < 10_000_000 for file in files)
    assert not any(name.endswith("()") for name in origins)
    assert paths >= {path for some in SEEDS.values() for path in some}


@pytest.mark.realdata
def test_the_real_files_are_those_of_the_table(real, tmp_path, capsys):
    published, folder = tmp_path / "published", tmp_path / "data"
    for file in (file for some in read_table(real_data.TABLE).values() for file in some):
        place = published / file.repository / file.commit / file.source
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(real / file.path)
    assert main(["--base", published.as_uri(), str(folder)]) == 0, capsys.readouterr().err
    assert main(["--check", str(folder)]) == 0
