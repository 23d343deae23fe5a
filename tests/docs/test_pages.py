"""The pages for people: the commands, files and links that they name exist."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup

from specimap_cli.app import app
from tests.support.places import DOCS, ROOT

README = ROOT / "README.md"
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
FOLDERS = "core|infra|service|workers|cli|validation|client|tests|bench|docker|docs|samples"
PAGES = [
    README,
    CONTRIBUTING,
    ROOT / "SECURITY.md",
    *sorted(DOCS.rglob("*.md")),
    ROOT / "samples" / "README.md",
    ROOT / "client" / "README.md",
]
WITH_HISTORY = [*PAGES, ROOT / "CHANGELOG.md"]
README_WORDS = 600


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def prose(page: Path) -> str:
    """The text of a page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The fragments that GitHub gives the headings of a page, and those that the page names itself."""
    text = prose(page)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return slugs | set(re.findall(r'<a name="([^"]+)">', text))


def test_the_readme_is_short_and_names_both_commands() -> None:
    text = README.read_text("utf-8")
    assert len(text.split()) <= README_WORDS
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for target in ("demo", "test"):
        assert f"    make {target} " in text
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)


@pytest.mark.parametrize("page", WITH_HISTORY, ids=page_name)
def test_links_lead_to_a_file_and_a_heading(page: Path) -> None:
    for target, fragment in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", prose(page)):
        if "://" in target:
            continue
        other = (page.parent / target).resolve() if target else page
        assert other.exists(), f"{page_name(page)} links to {target}"
        if fragment:
            assert fragment in anchors(other), f"{page_name(page)} links to {target}#{fragment}"


def test_the_index_links_to_every_page() -> None:
    index = (DOCS / "README.md").read_text("utf-8")
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} - {"README.md"}
    assert {name for name in pages if f"]({name})" not in index} == set()


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_files_and_modules_that_a_page_names_exist(page: Path) -> None:
    text = page.read_text("utf-8")
    for name in re.findall(rf"(?<![\w/.-])(?:{FOLDERS})/[\w./-]*\.(?:py|md|sh|ya?ml|lock)\b", text):
        assert (ROOT / name).exists() or (page.parent / name).exists(), f"{page_name(page)} names {name}"
    for module in re.findall(r"python -m ([a-z_.]*[a-z_])", text):
        assert find_spec(module) is not None, f"{page_name(page)} names the module {module}"


def test_names_in_the_guide_for_contributors_are_where_it_says() -> None:
    text = " ".join(CONTRIBUTING.read_text("utf-8").split())
    found = re.findall(r"`(\w+)`[^`]{0,20}\bin `([\w/]+\.py)`", text)
    assert len(found) > 8
    for name, path in found:
        assert re.search(rf"\b{name}\b", (ROOT / path).read_text("utf-8")), f"{path} has no {name}"


def commands() -> dict[str, set[str]]:
    """Options of each command, by its words: `keys create` among them."""
    root = typer.main.get_command(app)
    assert isinstance(root, TyperGroup)
    found: dict[str, set[str]] = {}
    for name, command in root.commands.items():
        inner = command.commands if isinstance(command, TyperGroup) else {}
        for words, leaf in ((name, command), *((f"{name} {below}", leaf) for below, leaf in inner.items())):
            found[words] = {option for p in leaf.params for option in (*p.opts, *p.secondary_opts)}
    return found


@pytest.mark.parametrize("page", [*PAGES, ROOT / "Makefile"], ids=page_name)
def test_commands_on_the_pages_exist(page: Path) -> None:
    known, text = commands(), page.read_text("utf-8").replace("\\\n", " ")
    for words in re.findall(r"(?:/|`|=\S+ |^ {4})specimap ([a-z][^`\n#]*)", text, re.MULTILINE):
        two, one = " ".join(words.split()[:2]), words.split()[0]
        options = known.get(two, known.get(one))
        assert options is not None, f"{page.name}: specimap {words}"
        assert set(re.findall(r"(?<!\S)--[a-z-]+", words)) <= options, f"{page.name}: specimap {words}"


def test_commands_that_do_not_exist_are_seen() -> None:
    known = commands()
    assert {"run", "serve", "worker", "demo", "keys create", "keys list", "keys revoke"} <= set(known)
    assert "--no-worker" in known["serve"]
    assert "--scopes" not in known["keys create"]
