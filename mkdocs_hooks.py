"""For the site: what the pages link to outside ``docs`` is brought along, so that no link leads nowhere."""

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent
#: Links of the pages to files of the repository.
_OUTSIDE = re.compile(r"\]\(\.\./([^)#]+)(#[^)]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Add every file that a page links to by ``../``; Markdown as it is, to be read as text."""
    from mkdocs.structure.files import File

    for page in Path(config["docs_dir"]).glob("*.md"):
        for path, _ in _OUTSIDE.findall(page.read_text()):
            name = _name(path)
            if (ROOT / path).is_file() and files.get_file_from_path(name) is None:
                files.append(File.generated(config, name, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Lead those links to the copies, and say a folder's name without a link."""

    def led(found: "re.Match[str]") -> str:
        return f"]({_name(found[1])})"

    folders = re.sub(r"\[([^\]]+)\]\(\.\./([^)#]+/)\)", r"`\2`", markdown)
    return _OUTSIDE.sub(led, folders)


def _name(path: str) -> str:
    """Below ``repository``, and never a page of the site itself."""
    return f"repository/{path}" + (".txt" if path.endswith((".md", ".proto")) else "")
