"""A corpus behind a web server: read once, kept by hash, every failure one clear error."""

import errno
import importlib.util
import re
import subprocess
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import datasets
import numpy as np
import pytest
from fsspec.implementations.http import HTTPFileSystem

import mint_hub
from mint_hub.cli import main
from mint_hub.loaders.location import corpus_files
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.tar_layout import CorpusError
from tests.episodes import make_episode

SHARD_BYTES = 80_000


class Web:
    """A server of a folder that can be told what to do wrong, by the end of a path."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.wrong, self.lists, self.asked = folder, {}, True, []
        web = self

        class Handler(SimpleHTTPRequestHandler):
            def __init__(self, *args):
                super().__init__(*args, directory=str(folder))

            def log_message(self, format, *args):
                pass

            def list_directory(self, path):
                if web.lists:
                    return super().list_directory(path)
                self.send_error(403)

            def do_HEAD(self):
                self.answer(super().do_HEAD)

            def do_GET(self):
                web.asked.append(self.path)
                self.answer(super().do_GET)

            def answer(self, usual):
                how = next((w for end, w in web.wrong.items() if self.path.endswith(end)), None)
                data = (folder / self.path.lstrip("/")).read_bytes() if how else b""
                if how is None:
                    usual()
                elif isinstance(how, int):
                    self.send_error(how)
                else:
                    getattr(self, how)(data)

            def cut(self, data):
                self.send(data[: len(data) // 2], len(data))

            def short(self, data):
                self.send(data[: len(data) // 2], len(data) // 2)

            def flipped(self, data):
                self.send(data[:700] + bytes([data[700] ^ 1]) + data[701:], len(data))

            def without_length(self, data):
                self.send(data, None)

            def nothing(self, data):
                self.close_connection = True
                self.connection.close()

            def dies(self, data):
                self.cut(data)
                web.server.socket.close()

            def send(self, data, length):
                self.send_response(200)
                if length is not None:
                    self.send_header("Content-Length", str(length))
                self.send_header("Connection", "close")
                self.end_headers()
                if self.command == "GET":
                    self.wfile.write(data)
                self.close_connection = True

        class Server(ThreadingHTTPServer):
            def handle_error(self, request, client_address):
                pass  # a connection that was broken on purpose

        self.server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True)
        self.thread.start()

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    for split, first in (("train", 0), ("validation", 100)):
        made = [make_episode(24, first + i, key=f"e-{first + i:03d}") for i in range(9)]
        write_corpus(made, folder, "ego4d", split, shard_bytes=SHARD_BYTES)
    return folder


@pytest.fixture
def web(corpus):
    server = Web(corpus)
    yield server
    server.close()


def files_in(folder: Path) -> set[str]:
    return {p.name for p in folder.rglob("*")} - {p.name for p in folder.glob("*")}


@pytest.mark.parametrize("how", [None, "without_length"])
def test_a_corpus_behind_a_web_server_reads_like_a_local_one(web, corpus, tmp_path, how):
    if how:
        web.wrong["-00000.tar"] = how
    local = CorpusReader(corpus, "ego4d")
    away = CorpusReader(web.url, "ego4d", cache_dir=tmp_path)
    assert not [path for path in web.asked if path.endswith(".tar")]
    assert all(a.allclose(b, atol=0) for a, b in zip(away, local, strict=True))
    tars = [path for path in web.asked if path.endswith(".tar")]
    assert len(tars) == len(set(tars)) == len(local.manifest.shards) > 1
    hashes = {s.sha256 for s in away.manifest.shards}
    assert hashes <= files_in(tmp_path)
    web.asked.clear()
    again = CorpusReader(web.url, "ego4d", cache_dir=tmp_path, verify="full")
    np.testing.assert_array_equal(again.arrays(8)["traj.npy"], local.arrays(8)["traj.npy"])
    assert [path.rsplit("/", 1)[1] for path in web.asked] == ["shards.json"]


WRONG = {
    "404": (404, r"expected this file \(\d episodes\), got none$"),
    "403": (403, r"\(\d episodes\), got none as fetching it failed: .*403"),
    "500": (500, r"\(\d episodes\), got none as fetching it failed: .*500"),
    "cut": ("cut", r"\(\d episodes\), got none as fetching it failed: "),
    "short": ("short", r"expected \d+ bytes \(\d episodes\), got \d+$"),
    "flipped": ("flipped", r"expected sha256 .* other bytes than were written"),
    "nothing": ("nothing", r"\(\d episodes\), got none as fetching it failed: "),
    "dies": ("dies", r"\(\d episodes\), got none as fetching it failed: "),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_goes_wrong_is_one_error_and_the_cache_stays_clean(web, corpus, tmp_path, case):
    how, message = WRONG[case]
    away = CorpusReader(web.url, "ego4d", cache_dir=tmp_path)
    away.key(0)  # the table
    before = files_in(tmp_path)
    web.wrong["-00000.tar"] = how
    with pytest.raises(CorpusError, match=f"^{web.url}/ego4d/train/ego4d-train-00000.tar: ") as e:
        away[0]
    assert re.search(message, str(e.value)), str(e.value)
    assert files_in(tmp_path) == before
    if case == "dies":
        with pytest.raises(CorpusError, match=r"-00001\.tar: expected this file .* failed: "):
            away[len(away) - 1]
        assert files_in(tmp_path) == before
        return
    web.wrong.clear()
    assert away[0].allclose(CorpusReader(corpus, "ego4d")[0], atol=0)


def test_shards_that_cannot_be_fetched_may_be_skipped_and_are_counted(web, tmp_path):
    web.wrong["-00000.tar"] = "cut"
    away = CorpusReader(web.url, "ego4d", cache_dir=tmp_path, on_error="skip")
    lost = away.manifest.shards[0].samples
    assert len(list(away)) == len(away) - lost
    assert away.num_skipped == lost
    assert "00000.tar: expected this file" in away.problems[0]


@pytest.mark.parametrize("name", ["shards.json", "index.npy", "episodes.parquet"])
@pytest.mark.parametrize("how", [404, 500, "cut", "short", "flipped"])
def test_the_files_beside_the_shards_are_held_to_the_same(web, tmp_path, name, how):
    web.wrong[name] = how
    with pytest.raises(CorpusError, match=f"^{web.url}/ego4d/train/{name}: expected "):
        CorpusReader(web.url, "ego4d", cache_dir=tmp_path, text="jar")
    web.wrong.clear()
    assert len(CorpusReader(web.url, "ego4d", cache_dir=tmp_path, text="jar")) == 9


def test_no_server_and_no_such_corpus(web, tmp_path, capsys):
    with pytest.raises(CorpusError, match=r"ego4d/test/shards\.json: expected this file, got none"):
        CorpusReader(web.url, "ego4d", "test", cache_dir=tmp_path)
    gone = Web(tmp_path)
    gone.close()
    with pytest.raises(CorpusError, match=r"shards\.json: .* failed: .*[Cc]onnect"):
        CorpusReader(gone.url, "ego4d", cache_dir=tmp_path)
    call = ["pack", gone.url, "--config", "ego4d", "--videos", str(tmp_path), "-o", str(tmp_path)]
    assert main(call) == 2
    error = capsys.readouterr().err
    assert "shards.json" in error
    assert "Traceback" not in error


def test_a_full_disk_is_not_taken_for_a_fault_of_the_server(web, tmp_path, monkeypatch):
    fresh = {"skip_instance_cache": True}  # so that the patched function is looked up
    away = CorpusReader(
        web.url, "ego4d", cache_dir=tmp_path, on_error="skip", storage_options=fresh
    )

    async def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(HTTPFileSystem, "_get_file", full)
    with pytest.raises(OSError, match="No space left"):
        away[0]


@pytest.mark.parametrize("lists", [True, False])
@pytest.mark.parametrize("streaming", [True, False])
def test_load_dataset_takes_the_address(web, corpus, tmp_path, lists, streaming):
    web.lists = lists
    assert set(corpus_files("ego4d", web.url).splits) == {"train", "validation"}
    options = {"location": web.url, "cache_dir": str(tmp_path), "streaming": streaming}
    rows = mint_hub.load_dataset("ego4d", "train", **options)
    local = CorpusReader(corpus, "ego4d")
    assert [row["key"] for row in rows] == [local.key(i) for i in range(9)]
    assert isinstance(rows, datasets.IterableDataset) == streaming


def test_load_dataset_names_what_is_missing_there(web):
    for lists in (True, False):
        web.lists = lists
        web.wrong["validation/ego4d-validation-00000.tar"] = 404
        if not lists:
            with pytest.raises(CorpusError, match=r"validation-00000\.tar: expected .*got none"):
                corpus_files("ego4d", web.url)
        web.wrong.clear()
        with pytest.raises(ValueError, match="config: expected one of"):
            corpus_files("epic", web.url)


MISSING = """
import sys
sys.modules[{module!r}] = None
from mint_hub.loaders.reader import CorpusReader
try:
    CorpusReader({url!r}, "ego4d")
except ImportError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("module", "url", "said"),
    [("aiohttp", "http://127.0.0.1:9/x", "aiohttp"), ("s3fs", "s3://bucket/x", "s3fs")],
)
def test_a_package_that_an_address_needs_is_named(module, url, said):
    assert importlib.util.find_spec("aiohttp") is not None  # comes with datasets
    code = MISSING.format(module=module, url=url)
    home = Path(mint_hub.__file__).parent.parent
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=home, capture_output=True, text=True, check=True
    )
    assert said in done.stdout
