"""A Hugging Face Hub on 127.0.0.1, as far as transformers, datasets and huggingface_hub need it.

Repositories live in memory with their commits, branches and tags, so that revisions, private
repositories, pushes and offline caches can be tested end to end without network:

    with LoopbackHub() as hub:
        repo = hub.add("org/name", {"config.json": b"{}"})
        subprocess.run([...], env=os.environ | hub.environment(home))

Clients read the environment when they are imported, hence the subprocess.
"""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import parse_qs, unquote, urlsplit

OWNER_TOKEN = "hf_owner"
OWNER = "org"
LFS_SUFFIXES = {".safetensors", ".npy", ".npz", ".tar", ".mp4", ".parquet", ".bin"}
DATE = "2026-01-01T00:00:00.000Z"


class HubError(Exception):
    """An answer that is no success: status, the hub's error code, and a message."""

    def __init__(self, status: int, code: str, message: str) -> None:
        super().__init__(message)
        self.status, self.code, self.message = status, code, message


@dataclass(frozen=True)
class Commit:
    sha: str
    message: str
    parent: str | None
    files: Mapping[str, bytes]


@dataclass
class Repo:
    """A repository: its commits by hash, and what its branches and tags point to."""

    kind: str  # "models" or "datasets", as in the addresses
    name: str
    private: bool = False
    commits: dict[str, Commit] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.branches:
            self.commit("initial commit", {})

    def commit(self, message: str, files: Mapping[str, bytes], branch: str = "main") -> Commit:
        """Add a commit that makes ``files`` the whole content of a branch."""
        parent = self.branches.get(branch)
        seed = f"{self.kind}/{self.name}/{len(self.commits)}/{parent}/{message}"
        sha = hashlib.sha1(seed.encode()).hexdigest()
        self.commits[sha] = Commit(sha, message, parent, dict(files))
        self.branches[branch] = sha
        return self.commits[sha]

    def at(self, revision: str) -> Commit:
        sha = self.branches.get(revision) or self.tags.get(revision) or revision
        if sha not in self.commits:
            raise HubError(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return self.commits[sha]

    def history(self, revision: str) -> list[Commit]:
        """Commits, the newest first."""
        found = [self.at(revision)]
        while found[-1].parent is not None:
            found.append(self.commits[found[-1].parent])
        return found

    def info(self, commit: Commit) -> dict[str, Any]:
        return {
            "_id": "0" * 24,
            "id": self.name,
            "modelId": self.name,
            "author": self.name.split("/")[0],
            "sha": commit.sha,
            "lastModified": DATE,
            "createdAt": DATE,
            "private": self.private,
            "gated": False,
            "disabled": False,
            "downloads": 0,
            "likes": 0,
            "tags": [],
            "siblings": [{"rfilename": path} for path in sorted(commit.files)],
        }


class LoopbackHub:
    """The server; a context manager. ``requests`` lists what was asked for, as "METHOD path"."""

    def __init__(self) -> None:
        self.repos: dict[tuple[str, str], Repo] = {}
        self.tokens = {OWNER_TOKEN: OWNER}
        self.lfs: dict[str, bytes] = {}
        self.requests: list[str] = []
        self.lock = threading.RLock()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
        self._server.daemon_threads = True
        self._server.hub = self  # type: ignore[attr-defined]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def environment(self, home: Path, token: str | None = OWNER_TOKEN) -> dict[str, str]:
        """Make variables that send a client here, with its caches in ``home``."""
        variables = {
            "HF_ENDPOINT": self.url,
            "HF_HOME": str(home),
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "HF_HUB_DISABLE_PROGRESS_BARS": "1",
            "HF_HUB_OFFLINE": "0",
            "NO_PROXY": "127.0.0.1",
        }
        return variables | ({} if token is None else {"HF_TOKEN": token})

    def add(
        self,
        name: str,
        files: Mapping[str, bytes] | Path,
        *,
        kind: str = "models",
        private: bool = False,
    ) -> Repo:
        """Make a repository, or add a commit to it, without any client."""
        if isinstance(files, Path):
            found = (path for path in files.rglob("*") if path.is_file())
            files = {path.relative_to(files).as_posix(): path.read_bytes() for path in found}
        with self.lock:
            repo = self.repos.setdefault((kind, name), Repo(kind, name, private))
            repo.commit("files", {**repo.at("main").files, **files})
        return repo


Answer = tuple[int, dict[str, str], bytes]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    @property
    def hub(self) -> LoopbackHub:
        return self.server.hub  # type: ignore[attr-defined]

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def _answer(self) -> None:
        split = urlsplit(self.path)
        self.query = parse_qs(split.query)
        self.content = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        method = "GET" if self.command == "HEAD" else self.command
        with self.hub.lock:
            self.hub.requests.append(f"{self.command} {split.path}")
            try:
                status, headers, body = self._route(method, split.path)
            except HubError as error:
                headers = {"X-Error-Code": error.code, "X-Error-Message": error.message}
                status, body = error.status, json.dumps({"error": error.message}).encode()
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = _answer  # noqa: N815

    def _route(self, method: str, path: str) -> Answer:
        for expected, pattern, action in _ROUTES:
            found = re.fullmatch(pattern, path)
            if method == expected and found:
                return action(self, **{k: unquote(v) for k, v in found.groupdict("").items()})
        raise HubError(404, "", f"{method} {path}: no such address on the loopback hub")

    def user(self) -> str | None:
        header = self.headers.get("Authorization")
        if header is None:
            return None
        user = self.hub.tokens.get(header.removeprefix("Bearer "))
        if user is None:
            raise HubError(401, "", "Invalid credentials in Authorization header")
        return user

    def repo(self, kind: str, name: str, write: bool = False) -> Repo:
        repo = self.hub.repos.get((kind, name))
        user = self.user()
        hidden = repo is None or (repo.private and user != name.split("/")[0])
        if hidden:
            raise HubError(404 if user else 401, "RepoNotFound", "Repository not found")
        if write and user != name.split("/")[0]:
            raise HubError(
                403 if user else 401, "", f"{user or 'anonymous'} may not write to {name}"
            )
        return repo

    def json(self) -> Any:
        return json.loads(self.content or b"{}")


def _json(content: Any, status: int = 200) -> Answer:
    return status, {"Content-Type": "application/json"}, json.dumps(content).encode()


def _whoami(request: _Handler) -> Answer:
    user = request.user()
    if user is None:
        raise HubError(401, "", "Invalid username or password.")
    auth = {"type": "access_token", "accessToken": {"displayName": "test", "role": "write"}}
    return _json({"type": "user", "name": user, "fullname": user, "orgs": [], "auth": auth})


def _create(request: _Handler) -> Answer:
    wanted, user = request.json(), request.user()
    if user is None:
        raise HubError(401, "", "Invalid username or password.")
    kind = wanted.get("type", "model") + "s"
    name = f"{wanted.get('organization') or user}/{wanted['name']}"
    if name.split("/")[0] != user:
        raise HubError(403, "", f"{user} may not create {name}")
    prefix = "" if kind == "models" else f"{kind}/"
    answer = {"url": f"{request.hub.url}/{prefix}{name}", "name": name, "id": "0" * 24}
    if (kind, name) in request.hub.repos:
        return _json({"error": "You already created this repo", **answer}, HTTPStatus.CONFLICT)
    private = wanted.get("private") or wanted.get("visibility") == "private"
    request.hub.repos[kind, name] = Repo(kind, name, bool(private))
    return _json(answer)


def _delete(request: _Handler) -> Answer:
    wanted = request.json()
    kind = (wanted.get("type") or "model") + "s"
    name = f"{wanted.get('organization') or request.user()}/{wanted['name']}"
    request.repo(kind, name, write=True)
    del request.hub.repos[kind, name]
    return _json({})


def _info(request: _Handler, kind: str, name: str, revision: str) -> Answer:
    repo = request.repo(kind, name)
    return _json(repo.info(repo.at(revision or "main")))


def _refs(request: _Handler, kind: str, name: str) -> Answer:
    repo = request.repo(kind, name)

    def listed(refs: Mapping[str, str], folder: str) -> list[dict[str, str]]:
        return [
            {"name": k, "ref": f"refs/{folder}/{k}", "targetCommit": v} for k, v in refs.items()
        ]

    branches, tags = listed(repo.branches, "heads"), listed(repo.tags, "tags")
    return _json({"branches": branches, "converts": [], "tags": tags, "pullRequests": []})


def _commits(request: _Handler, kind: str, name: str, revision: str) -> Answer:
    commits = request.repo(kind, name).history(revision)
    return _json(
        [
            {"id": c.sha, "title": c.message, "message": "", "date": DATE, "authors": []}
            for c in commits
        ]
    )


def _branch(request: _Handler, kind: str, name: str, branch: str) -> Answer:
    repo = request.repo(kind, name, write=True)
    if request.command == "DELETE":
        del repo.branches[branch]
    elif branch in repo.branches:
        raise HubError(409, "", f"Reference already exists: {branch}")
    else:
        repo.branches[branch] = repo.at(request.json().get("startingPoint", "main")).sha
    return _json({})


def _tag(request: _Handler, kind: str, name: str, revision: str) -> Answer:
    repo, tag = request.repo(kind, name, write=True), request.json()["tag"]
    if tag in repo.tags:
        raise HubError(409, "", f"Tag reference exists already: {tag}")
    repo.tags[tag] = repo.at(revision).sha
    return _json({})


def _entry(path: str, content: bytes) -> dict[str, Any]:
    entry: dict[str, Any] = {"type": "file", "path": path, "size": len(content)}
    entry["oid"] = _git_oid(content)
    if _is_lfs(path):
        entry["lfs"] = {"oid": _sha256(content), "size": len(content), "pointerSize": 134}
    return entry


def _tree(request: _Handler, kind: str, name: str, revision: str, folder: str) -> Answer:
    files = request.repo(kind, name).at(revision).files
    start = f"{folder}/" if folder else ""
    inside = {path: content for path, content in sorted(files.items()) if path.startswith(start)}
    if folder and not inside:
        raise HubError(404, "EntryNotFound", f"{folder} does not exist on {revision}")
    entries, folders = [], set()
    recursive = request.query.get("recursive", ["false"])[0].lower() in ("true", "1")
    for path, content in inside.items():
        *parents, last = path.removeprefix(start).split("/")
        known = ["/".join(parents[: k + 1]) for k in range(len(parents))]
        folders |= {start + parent for parent in (known if recursive else known[:1])}
        if recursive or not parents:
            entries.append(_entry(start + "/".join([*parents, last]), content))
    listed = [
        {"type": "directory", "path": path, "oid": _git_oid(path.encode()), "size": 0}
        for path in sorted(folders)
    ]
    return _json([*listed, *entries])


def _paths_info(request: _Handler, kind: str, name: str, revision: str) -> Answer:
    files = request.repo(kind, name).at(revision).files
    if request.headers.get("Content-Type", "").startswith("application/json"):
        paths = request.json()["paths"]
    else:
        paths = parse_qs(request.content.decode()).get("paths", [])
    entries = [_entry(path, files[path]) for path in paths if path in files]
    for path in paths:
        if path not in files and any(known.startswith(f"{path}/") for known in files):
            entries.append({"type": "directory", "path": path, "oid": "0" * 40, "size": 0})
    return _json(entries)


def _resolve(request: _Handler, kind: str, name: str, revision: str, path: str) -> Answer:
    commit = request.repo(kind.removesuffix("/") or "models", name).at(revision)
    headers = {"X-Repo-Commit": commit.sha, "Accept-Ranges": "bytes"}
    if path not in commit.files:
        raise HubError(404, "EntryNotFound", f"{path} does not exist on {revision}")
    content = commit.files[path]
    etag = _sha256(content) if _is_lfs(path) else _git_oid(content)
    headers |= {"ETag": f'"{etag}"', "Content-Type": "application/octet-stream"}
    if _is_lfs(path):
        headers |= {"X-Linked-Etag": f'"{etag}"', "X-Linked-Size": str(len(content))}
    wanted = re.fullmatch(r"bytes=(\d*)-(\d*)", request.headers.get("Range", ""))
    if wanted is None:
        return 200, headers, content
    first, last = wanted.groups()
    start = int(first) if first else max(0, len(content) - int(last))
    stop = min(len(content), int(last) + 1) if first and last else len(content)
    if start >= len(content):
        headers["Content-Range"] = f"bytes */{len(content)}"
        return HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, headers, b""
    headers["Content-Range"] = f"bytes {start}-{stop - 1}/{len(content)}"
    return HTTPStatus.PARTIAL_CONTENT, headers, content[start:stop]


def _preupload(request: _Handler, kind: str, name: str, revision: str) -> Answer:
    request.repo(kind, name, write=True).at(revision)
    files = [
        {
            "path": file["path"],
            "uploadMode": "lfs" if _is_lfs(file["path"]) else "regular",
            "shouldIgnore": False,
            "oid": None,
        }
        for file in request.json()["files"]
    ]
    return _json({"files": files})


def _lfs_batch(request: _Handler, kind: str, name: str) -> Answer:
    request.repo(kind.removesuffix("/") or "models", name, write=True)
    objects: list[dict[str, Any]] = []
    for wanted in request.json()["objects"]:
        answer: dict[str, Any] = {"oid": wanted["oid"], "size": wanted["size"]}
        if wanted["oid"] not in request.hub.lfs:
            answer["actions"] = {"upload": {"href": f"{request.hub.url}/lfs/{wanted['oid']}"}}
        objects.append(answer)
    return _json({"transfer": "basic", "objects": objects})


def _lfs_upload(request: _Handler, oid: str) -> Answer:
    if _sha256(request.content) != oid:
        raise HubError(400, "", f"content is not {oid}")
    request.hub.lfs[oid] = request.content
    return _json({})


def _commit(request: _Handler, kind: str, name: str, revision: str) -> Answer:
    repo = request.repo(kind, name, write=True)
    if revision not in repo.branches:
        raise HubError(404, "RevisionNotFound", f"Invalid rev id: {revision}")
    files, message = dict(repo.at(revision).files), ""
    for line in request.content.splitlines():
        item = json.loads(line)
        value = item["value"]
        if item["key"] == "header":
            message = value["summary"]
        elif item["key"] == "file":
            files[value["path"]] = base64.b64decode(value["content"])
        elif item["key"] == "lfsFile":
            files[value["path"]] = request.hub.lfs[value["oid"]]
        elif item["key"] == "deletedFile":
            del files[value["path"]]
        elif item["key"] == "deletedFolder":
            start = value["path"].rstrip("/") + "/"
            files = {path: content for path, content in files.items() if not path.startswith(start)}
        else:
            raise HubError(400, "", f"commit: {item['key']} is not known to the loopback hub")
    commit = repo.commit(message, files, revision)
    url = f"{request.hub.url}/{'' if kind == 'models' else kind + '/'}{name}/commit/{commit.sha}"
    return _json({"success": True, "commitOid": commit.sha, "commitUrl": url, "hookOutput": ""})


def _validate_yaml(request: _Handler) -> Answer:
    return _json({"errors": [], "warnings": []})


def _is_lfs(path: str) -> bool:
    return Path(path).suffix in LFS_SUFFIXES


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _git_oid(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


_API = r"/api/(?P<kind>models|datasets)/(?P<name>[^/]+/[^/]+)"
_FILE = r"/(?P<kind>datasets/)?(?P<name>[^/]+/[^/]+)"
_ROUTES: list[tuple[str, str, Callable[..., Answer]]] = [
    ("GET", r"/api/whoami-v2", _whoami),
    ("POST", r"/api/repos/create", _create),
    ("DELETE", r"/api/repos/delete", _delete),
    ("POST", r"/api/validate-yaml", _validate_yaml),
    ("GET", _API + r"(?:/revision/(?P<revision>[^/]+))?", _info),
    ("GET", _API + r"/refs", _refs),
    ("GET", _API + r"/commits/(?P<revision>[^/]+)", _commits),
    ("POST", _API + r"/branch/(?P<branch>[^/]+)", _branch),
    ("DELETE", _API + r"/branch/(?P<branch>[^/]+)", _branch),
    ("POST", _API + r"/tag/(?P<revision>[^/]+)", _tag),
    ("GET", _API + r"/tree/(?P<revision>[^/]+)(?:/(?P<folder>.+))?", _tree),
    ("POST", _API + r"/paths-info/(?P<revision>[^/]+)", _paths_info),
    ("POST", _API + r"/preupload/(?P<revision>[^/]+)", _preupload),
    ("POST", _API + r"/commit/(?P<revision>[^/]+)", _commit),
    ("POST", _FILE + r"\.git/info/lfs/objects/batch", _lfs_batch),
    ("PUT", r"/lfs/(?P<oid>[0-9a-f]{64})", _lfs_upload),
    ("GET", _FILE + r"/resolve/(?P<revision>[^/]+)/(?P<path>.+)", _resolve),
    ("GET", _FILE + r"/raw/(?P<revision>[^/]+)/(?P<path>.+)", _resolve),
]
