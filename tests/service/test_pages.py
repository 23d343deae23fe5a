"""The web pages: which files are served, how browsers keep them, and what they may do; what else a browser may open."""

from __future__ import annotations

import gzip
import re
import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from specimap_infra.tables import Export, StoredFile
from specimap_service.page_files import NOT_BUILT, read_pages
from tests.support.job_scene import acquisition
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving

SCRIPT = b"export const colours = " + b"'viridis', " * 500
FILES = {
    "index.html": b"<!doctype html><title>Specimap</title>" + b"<p>words</p>" * 200,
    "sw.js": b"self.addEventListener('fetch', () => {});" * 50,
    "manifest.webmanifest": b'{"name": "Specimap"}',
    "icon-192.png": b"\x89PNG\r\n\x1a\n" + bytes(2000),
    "assets/viewer-3f9a.js": SCRIPT,
    "assets/style-77aa.css": b"body { margin: 0 } " * 100,
    "assets/decode-01bc.wasm": b"\0asm" + bytes(3000),
    "assets/tiny-0000.js": b"1",
    "assets/fonts/sans-1234.woff2": b"wOF2" + bytes(50),
}
TYPES = {
    "index.html": "text/html; charset=utf-8",
    "sw.js": "text/javascript; charset=utf-8",
    "manifest.webmanifest": "application/manifest+json",
    "icon-192.png": "image/png",
    "assets/viewer-3f9a.js": "text/javascript; charset=utf-8",
    "assets/style-77aa.css": "text/css; charset=utf-8",
    "assets/decode-01bc.wasm": "application/wasm",
    "assets/tiny-0000.js": "text/javascript; charset=utf-8",
    "assets/fonts/sans-1234.woff2": "font/woff2",
}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A made-up folder of built pages, with what does not belong there."""
    place = tmp_path_factory.mktemp("build")
    folder = place / "pages"
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    (place / "secret.txt").write_text("secret", encoding="utf-8")
    (place / "secrets").mkdir()
    (place / "secrets" / "more.txt").write_text("secret", encoding="utf-8")
    (folder / "link.txt").symlink_to(place / "secret.txt")
    (folder / "linked").symlink_to(place / "secrets")
    (folder / ".hidden").write_text("secret", encoding="utf-8")
    (folder / ".git").mkdir()
    (folder / ".git" / "config").write_text("secret", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def site(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with serving(tmp_path_factory.mktemp("site"), pages=built) as running:
        yield running


def stranger(service: Running) -> httpx.Client:
    """A client without a key."""
    client = httpx.Client(base_url=service.url, trust_env=False, verify=NO_TLS)
    service.clients.append(client)
    return client


def test_all_files_are_served_as_they_were_built(site: Running) -> None:
    client = stranger(site)
    for name, content in FILES.items():
        answer = client.get(f"/{name}")
        assert (answer.status_code, answer.content) == (200, content), name
        assert answer.headers["content-type"] == TYPES[name]
        assert answer.headers["x-content-type-options"] == "nosniff"
    assert client.get("/").content == FILES["index.html"]


@pytest.mark.parametrize("name", sorted(FILES))
def test_browsers_keep_hashed_names_and_ask_again_for_others(site: Running, name: str) -> None:
    client = stranger(site)
    answer = client.get(f"/{name}")
    hashed = name.startswith("assets/")
    assert answer.headers["cache-control"] == ("public, max-age=31536000, immutable" if hashed else "no-cache")
    tag = answer.headers["etag"]
    again = client.get(f"/{name}", headers={"If-None-Match": tag})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    assert client.get(f"/{name}", headers={"If-None-Match": '"other"'}).status_code == 200


@pytest.mark.parametrize(
    ("name", "smaller"),
    [("index.html", True), ("assets/viewer-3f9a.js", True), ("icon-192.png", False), ("assets/tiny-0000.js", False)],
)
def test_texts_are_compressed_for_those_who_take_it(site: Running, name: str, smaller: bool) -> None:
    client = stranger(site)
    tags = set()
    for accepted, wanted in (("gzip, br", smaller), ("identity", False), ("gzip;q=0", False)):
        with client.stream("GET", f"/{name}", headers={"Accept-Encoding": accepted}) as answer:
            sent = b"".join(answer.iter_raw())
        assert answer.headers["vary"] == "Accept-Encoding"
        assert (answer.headers.get("content-encoding") == "gzip") == wanted
        assert int(answer.headers["content-length"]) == len(sent)
        assert (len(sent) < len(FILES[name])) == wanted
        assert (gzip.decompress(sent) if wanted else sent) == FILES[name]
        tags.add(answer.headers["etag"])
    assert len(tags) == 1 + smaller, "one tag, one sequence of bytes"


def test_head_tells_what_get_sends(site: Running) -> None:
    client = stranger(site)
    for name in ("", *FILES):
        got, told = client.get(f"/{name}"), client.head(f"/{name}")
        assert (told.status_code, told.content) == (200, b"")
        for header in ("content-type", "content-length", "etag", "cache-control", "content-security-policy"):
            assert told.headers[header] == got.headers[header], name


@pytest.mark.parametrize("query", ["x=1", "utm_source=mail&x=1&x=2", "%00", "a=%FF"])
def test_a_query_on_a_link_to_a_page_is_left_to_the_page(site: Running, query: str) -> None:
    assert stranger(site).get(f"/?{query}").content == FILES["index.html"]


@pytest.mark.parametrize(
    "path",
    [
        "/link.txt",
        "/linked/more.txt",
        "/.hidden",
        "/.git/config",
        "/../secret.txt",
        "/assets/../../secret.txt",
        "/assets/../index.html",
        "/%2e%2e/secret.txt",
        "/..%2fsecret.txt",
        "/assets/..%5c..%5csecret.txt",
        "//index.html",
        "/./index.html",
        "/assets",
        "/assets/",
        "/index.html/",
        "/INDEX.HTML",
        "/index.html%00",
        "/pages/index.html",
        "/assets/missing-0000.js",
        "/etc/passwd",
    ],
)
def test_no_other_path_leads_anywhere(site: Running, path: str) -> None:
    host, port = site.url.removeprefix("http://").split(":")
    # A client would tidy the path up first.
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n".encode())
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 404 "), head
    assert b"application/problem+json" in head
    assert b"secret\n" not in body
    assert b'"code":"not_found"' in body


def test_pages_only_take_what_reads(site: Running) -> None:
    admin = site.client()
    for method in ("POST", "PUT", "DELETE", "PATCH"):
        assert admin.request(method, "/index.html").status_code == 404


def test_pages_may_run_own_scripts_only(site: Running) -> None:
    client = stranger(site)
    for path in ("/", "/sw.js", "/assets/viewer-3f9a.js"):
        headers = client.get(path).headers
        policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
        assert policy == {
            "default-src": "'none'",
            "script-src": "'self' 'wasm-unsafe-eval'",
            "style-src": "'self'",
            "img-src": "'self' blob: data:",
            "connect-src": "'self'",
            "worker-src": "'self' blob:",
            "manifest-src": "'self'",
            "font-src": "'self'",
            "media-src": "'self' blob:",
            "base-uri": "'none'",
            "form-action": "'none'",
            "frame-ancestors": "'none'",
        }
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["permissions-policy"] == "camera=(self), microphone=(), geolocation=()"
        assert headers["x-frame-options"] == "DENY"
        assert headers["cross-origin-opener-policy"] == "same-origin"
        assert "strict-transport-security" not in headers
        assert "set-cookie" not in headers


@pytest.mark.parametrize(
    ("public_url", "told"), [("https://specimap.example/base/", "max-age=31536000"), ("http://specimap.example", None)]
)
def test_browsers_are_told_to_stay_with_tls_where_there_is_tls(
    built: Path, tmp_path: Path, public_url: str, told: str | None
) -> None:
    with serving(tmp_path, pages=built, public_url=public_url) as service:
        assert stranger(service).get("/").headers.get("strict-transport-security") == told


@pytest.mark.parametrize("made", [False, True])
def test_where_no_pages_are_built_the_service_says_so(tmp_path: Path, made: bool) -> None:
    folder = tmp_path / "pages"
    if made:
        folder.mkdir()
    with serving(tmp_path / "service", pages=folder) as service:
        answer = stranger(service).get("/")
        assert (answer.status_code, answer.content) == (200, NOT_BUILT)
        assert "make setup" in answer.text
        assert answer.headers["content-type"] == "text/html; charset=utf-8"
        (link,) = re.findall('href="([^"]+)"', answer.text)
        assert stranger(service).get(f"/{link}").status_code == 200
        assert stranger(service).get("/index.html").status_code == 404


def test_what_comes_later_is_not_served(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_bytes(b"first")
    found = read_pages(tmp_path)
    (tmp_path / "index.html").write_bytes(b"second")
    (tmp_path / "later.js").write_bytes(b"1")
    assert {path: file.content for path, file in found.items()} == {"/": b"first", "/index.html": b"first"}


def test_requests_for_pages_are_counted_as_such(site: Running) -> None:
    client, admin = stranger(site), site.client()
    for path in ("/", "/sw.js", "/assets/tiny-0000.js"):
        client.get(path)
    client.head("/")
    lines = [line for line in admin.get("/metrics").text.splitlines() if "handle_seconds_count" in line]
    counted = {line.split(" ")[0]: float(line.split(" ")[1]) for line in lines}
    assert counted['specimap_requests_handle_seconds_count{method="GET",route="pages",status="200"}'] >= 3
    assert counted['specimap_requests_handle_seconds_count{method="HEAD",route="pages",status="200"}'] >= 1
    assert not [name for name in counted if "index" in name or "assets" in name]


def test_pages_are_no_part_of_the_contract(site: Running) -> None:
    paths = stranger(site).get("/openapi.json").json()["paths"]
    assert {path.split("/")[1] for path in paths} == {"healthz", "readyz", "metrics", "v1"}


# ---- what else a browser may open ----------------------------------------------------------------------


def test_answers_of_the_api_can_run_nothing(site: Running) -> None:
    client = site.client()
    for answer in (
        client.get("/v1/jobs"),
        client.get("/healthz"),
        client.get("/v1/nowhere"),
        stranger(site).get("/v1/jobs"),
    ):
        policy = answer.headers["content-security-policy"]
        assert policy == "default-src 'none'; frame-ancestors 'none'; sandbox"


def test_description_keeps_its_scripts_but_no_frame(site: Running) -> None:
    for path in ("/docs", "/redoc"):
        answer = stranger(site).get(path)
        policy = answer.headers["content-security-policy"]
        # A script stands in the page, and it fetches no more than the service gives.
        assert "script-src 'self' 'unsafe-inline'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "http" not in policy
        assert "<script" in answer.text


def test_uploaded_files_and_results_never_run_as_pages(service: Running, tmp_path: Path) -> None:
    """Whatever is in a file, and whatever its type, it is a download, and sandboxed where a browser shows it anyway."""
    result = put_result(service, tmp_path / "result")
    owner, client = acquisition(service.database), service.client()
    hostile = b"<script>fetch('/v1/keys')</script>"
    with service.database.session() as session:
        photo = session.query(StoredFile).filter_by(acquisition_id=owner, role="photo").first()
        assert photo is not None
        photo.name = photo.label = 'x.html"\r\nContent-Type: text/html'
        service.storage.put(photo.storage_key, hostile)
        service.storage.put("exports/exp_1/report.html", hostile)
        session.add(
            Export(
                id=f"exp_{'0' * 26}",
                cloud_id=result.cloud_id,
                format="html",
                state="succeeded",
                storage_key="exports/exp_1/report.html",
                size=len(hostile),
                correlation_id="c",
                created_by="key_test",
            )
        )
        file_id = photo.id
    cloud = f"/v1/clouds/{result.cloud_id}"
    for path in (f"/v1/acquisitions/{owner}/files/{file_id}/content", f"{cloud}/exports/html/content"):
        answer = client.get(path)
        assert (answer.status_code, answer.content) == (200, hostile)
        assert answer.headers["content-disposition"].startswith("attachment; ")
        assert len(answer.headers.get_list("content-type")) == 1
    for path in (
        f"/v1/acquisitions/{owner}/files/{file_id}/content",
        f"{cloud}/exports/html/content",
        f"{cloud}/corners",
        f"{cloud}/zarr/zarr.json",
        f"{cloud}/previews/rgb.png",
    ):
        answer = client.get(path)
        policy = answer.headers["content-security-policy"].split("; ")
        assert {"default-src 'none'", "frame-ancestors 'none'", "sandbox"} <= set(policy), path
        assert not any(part.startswith("script-src") for part in policy), path
        assert answer.headers["x-content-type-options"] == "nosniff"
        # A browser that has signed out, or in as somebody else, takes nothing of it from its cache.
        assert {"Authorization", "Cookie"} <= set(answer.headers["vary"].split(", ")), path
    report = client.get(f"{cloud}/exports/html/content").headers["content-security-policy"]
    assert "style-src 'unsafe-inline'" in report
