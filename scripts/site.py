"""A hook of MkDocs (mkdocs.yml): the site also has the measurements in bench/ and the pages beside README.md.

In the repository a link goes from docs/ to ../bench/. On the site docs/ is the root, so that such a link has to lose its `..`.
A link to anything else in the repository goes to the repository itself.
"""
import os.path
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent
BESIDE = ("ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md")
SHOWN = {".md", ".svg", ".png", ".json", ".jsonl"}
LINK = re.compile(r"(\]\()([^)\s]+)")


def on_files(files, config):
    bench = [p.relative_to(ROOT).as_posix() for p in sorted(ROOT.glob("bench/**/*")) if p.suffix in SHOWN]
    for path in [*bench, *BESIDE]:
        files.append(File(path, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown, page, config, files):
    # Where the page is in the repository, and where on the site.
    here = Path(page.file.abs_src_path).resolve().relative_to(ROOT).parent.as_posix()
    site = os.path.dirname(page.file.src_uri)

    def moved(link):
        path, _, anchor = link[2].partition("#")
        if not path or re.match(r"[a-z]+:", path):
            return link[0]
        place = os.path.normpath(os.path.join(here, path))
        uri = place.removeprefix("docs/")
        if files.get_file_from_path(uri) is None:
            return f"{link[1]}{config.repo_url}/blob/main/{place}"
        return link[1] + os.path.relpath(uri, site or ".") + (f"#{anchor}" if anchor else "")

    return LINK.sub(moved, markdown)
