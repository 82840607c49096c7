"""The pages of the documentation as text: their code blocks, headings and links."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def pages():
    """The Markdown files of the repository, without what is built or belongs to somebody else."""
    below = [path for folder in ("docs", "tutorials", "envs", "sb3_combrel") for path in (ROOT / folder).rglob("*.md")]
    return sorted(path for path in [*ROOT.glob("*.md"), *below] if not {"_build", "output"} & set(path.parts))


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def blocks(text, language):
    """The code blocks of a language. What is written into a file of its own (``file=``) is none of them."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)


def commands(text):
    """The commands of the shell in a page, each as a list of words, without comments."""
    lines = [line for block in blocks(text, "(?:bash|sh)") for line in block.replace("\\\n", " ").splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def prose(text):
    """The text without its code blocks and comments, and without what cells of tutorials have printed."""
    text = re.sub(r"^<!-- output -->$.*?^<!-- end of output -->$", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^(```+).*?^\1", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"^<!--.*?-->", "", text, flags=re.DOTALL | re.MULTILINE)


def links(text):
    """Targets of links and pictures that lead to no other site. Code in the text of a link stays."""
    return [target for target in re.findall(r"\]\(\s*([^()\s]+)\s*\)", prose(text)) if not re.match(r"[a-z]+:", target)]


def anchors(text):
    """The anchors that a code host, and MyST, make of headings."""
    found = []
    for heading in re.findall(r"^#{1,6} +(.*?)\s*#*$", prose(text), flags=re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()).replace(" ", "-")
        n = sum(each == slug or re.fullmatch(rf"{re.escape(slug)}-\d+", each) is not None for each in found)
        found.append(f"{slug}-{n}" if n else slug)
    return set(found)
