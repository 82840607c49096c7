"""The documentation is short and says what holds: how it came about stands in ``docs/log.md`` and in the changelog."""

import re

import pytest
from helpers.pages import DOCS, ROOT, name_of, prose

#: What a person has to read; tables of runs below docs/results/ are written by commands, and the log is a notebook.
READ = [
    ROOT / "README.md",
    *sorted(page for page in [*DOCS.glob("*.md"), *DOCS.glob("results/*.md")] if page != DOCS / "log.md"),
    *sorted((ROOT / "tutorials").glob("*.md")),
]
#: About an hour at 250 words a minute, as tables are looked up and not read.
MOST_WORDS, MOST_WORDS_OF_THE_PAPER = 20_000, 3_000
#: Words by which a text compares with what it said, or what the code did, at an earlier time. "Before the first step" is none.
HISTORY = (
    r"(than|as|unlike) before\b",
    r"\b(what|where|when) (it|they|this|there) (was|were|had been) before\b",
    r"\b(was|were|been) tried\b",
    r"\basked(:| for:)",
    r"\bformer(ly)?\b",
    r"\bno longer\b(?! than)",
    r"\b(older|earlier|former|previous) versions?\b",
    r"\buntil version\b",
)


def words_of(text):
    """Words and numbers of a page without its code, outputs and comments; those of tables count, the lines between do not."""
    return [each for each in prose(text).split() if re.search(r"\w", each)]


def history_in(text):
    """What a page says of the past, as matched."""
    as_one_line = re.sub(r"\s+", " ", prose(text))
    return [found[0] for pattern in HISTORY for found in re.finditer(pattern, as_one_line, flags=re.IGNORECASE)]


def test_all_pages_together_have_at_most_20_000_words_without_the_paper():
    # The page for readers of the papers has a budget of its own.
    words = {name_of(page): len(words_of(page.read_text())) for page in READ}
    assert words.pop("docs/paper.md") <= MOST_WORDS_OF_THE_PAPER
    assert sum(words.values()) <= MOST_WORDS, sorted(words.items(), key=lambda item: -item[1])


def test_the_readme_has_at_most_1000_words():
    assert len(words_of((ROOT / "README.md").read_text())) <= 1_000


@pytest.mark.parametrize("page", READ, ids=name_of)
def test_a_page_says_what_holds_and_no_history(page):
    assert history_in(page.read_text()) == []


def test_words_of_prose_and_tables_count_and_those_of_code_outputs_and_comments_do_not():
    text = "# One two\n\nthree\n\n| four | 5 |\n\n```python\nsix = 6\n```\n\n"
    text += "<!-- output -->\n```text\n7\n```\n<!-- end of output -->\n"
    assert len(words_of(text + "<!-- numbers: eight\n-->\n")) == len("One two three four 5".split())


@pytest.mark.parametrize(
    "history",
    [
        *("It needs fewer steps than before.", "The rest is as\nbefore.", "More neighbours were tried.", "(asked: 2,450)"),
        *("The threshold is no longer read.", "Formerly it was 3.", "An earlier version took 11,285.", "Until version 0.2.0"),
    ],
)
def test_history_is_found(history):
    assert history_in(f"# Title\n\n{history}\n")


@pytest.mark.parametrize(
    "text", ["before the first step", "no longer than without", "is asked for", "try it before you trust it"]
)
def test_what_is_no_history_is_not_found(text):
    assert history_in(text) == []
