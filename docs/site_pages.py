"""Hook of the documentation site: pages that are made of other files of the repository.

README.md, CONTRIBUTING.md and CHANGELOG.md, whose links count from the top of the repository, become pages
of the site. Each room of the package gets a page of the names that its door exports, read from the source:
nothing is imported, so that a site is built where the package's dependencies are not installed.
"""

import ast
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pancam_graph"
TOP_PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add a page of each room to the navigation, in the order of the layers, the highest first."""
    assert config.nav is not None
    (api,) = (entry["Python API"] for entry in config.nav if "Python API" in entry)
    api += [{room: f"api/{room}.md"} for room in _rooms()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are no files of docs/."""
    for source, page in TOP_PAGES.items():
        text = _linked_from_docs((ROOT / source).read_text(encoding="utf-8"))
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, "api/pancam_graph.md", content=_api_page("pancam_graph", PACKAGE)))
    for room in _rooms():
        page = _api_page(f"pancam_graph.{room}", PACKAGE / room)
        files.append(File.generated(config, f"api/{room}.md", content=page))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links to the pages at the top of the repository lead to those of the site; source files have none."""
    for source, page in TOP_PAGES.items():
        markdown = markdown.replace(f"](../{source}", f"]({page}")
    return re.sub(r"\[([^\]]+)\]\([\w/.]+\.(?:py|cff)\)", r"\1", markdown)


def _linked_from_docs(text: str) -> str:
    """The text of a page at the top of the repository, with links as docs/ has them."""
    for source, page in TOP_PAGES.items():
        text = text.replace(f"]({source}", f"]({page}")
    return text.replace("](docs/", "](")


def _rooms() -> list[str]:
    """Rooms as the contract of layers has them, the highest first."""
    contract = (ROOT / ".importlinter").read_text(encoding="utf-8")
    (layers,) = re.findall(r"\nlayers =\n((?: +.+\n)+)", contract)
    return [room for room in re.split(r"[\s|]+", layers) if room]


def _api_page(module: str, folder: Path) -> str:
    """What a package's door exports: the names defined in the package whole, the others as links.

    Of a package with public modules, these.
    """
    tree = ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))
    exported = [
        (alias.name, _source_of(f"{node.module}.{alias.name}"))
        for node in _imports(tree)
        for alias in node.names
        if alias.asname is not None
    ]
    whole = [source for _, source in exported if source.startswith(f"{module}.") and module != "pancam_graph"]
    links = [f"- [`{name}`][{source}]" for name, source in exported if source not in whole]
    if not exported:
        whole = [f"{module}.{path.stem}" for path in sorted(folder.glob("[a-z]*.py"))]
    about = re.sub(r"::\n\n((?:    .*\n|\n)+)", r":\n\n\1", ast.get_docstring(tree) or "")
    return "\n".join([f"# {module}\n\n{about}\n", *links, "", *(f"::: {source}\n" for source in whole)])


def _source_of(name: str) -> str:
    """Where the source defines a name that a chain of doors hands on."""
    while True:
        module, _, last = name.rpartition(".")
        path = ROOT / Path(*module.split("."))
        file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        imports = _imports(ast.parse(file.read_text(encoding="utf-8")))
        origins = {f"{n.module}.{a.name}" for n in imports for a in n.names if (a.asname or a.name) == last}
        if not origins:
            return name
        (name,) = origins


def _imports(tree: ast.Module) -> list[ast.ImportFrom]:
    """Imports of a module, those for type checkers too."""
    nodes = [node for top in tree.body for node in (top.body if isinstance(top, ast.If) else [top])]
    return [node for node in nodes if isinstance(node, ast.ImportFrom)]
