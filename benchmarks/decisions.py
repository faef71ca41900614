"""Write the index of the decision log, ``docs/decisions/index.md``, by topic."""

import re
from dataclasses import dataclass
from pathlib import Path

from benchmarks.provenance import ROOT

FOLDER = ROOT / "docs" / "decisions"
INDEX = FOLDER / "index.md"
#: Topics in the order of the index.
TOPICS = (
    "simulator",
    "import",
    "map",
    "imaging",
    "retrieval",
    "encoder",
    "registration",
    "scoring",
    "confidence",
    "covariance",
    "sequences",
    "serving",
    "performance",
    "security",
    "evaluation",
    "comparison",
    "tools",
    "platforms",
)
_STATUS = re.compile(r"in use|rejected|replaced by \d{4}")
_FORM = re.compile(
    r"# (?P<number>\d{4})\. (?P<question>.+)\n\n- Date: (?P<date>\d{4}-\d\d-\d\d)\n- Status: (?P<status>.+)\n- Topic: (?P<topic>.+)\n"
    r"- Answer: (?P<answer>(?:.+\n(?:  .+\n)*))\n"
)


@dataclass(frozen=True, slots=True)
class Decision:
    """The head of one file of the decision log.

    Attributes:
        file: its name.
        number: four digits, unique.
        question: its title.
        date: ISO 8601.
        status: ``in use``, ``rejected`` or ``replaced by NNNN``.
        topic: one of ``TOPICS``.
        answer: one or two sentences.
    """

    file: str
    number: str
    question: str
    date: str
    status: str
    topic: str
    answer: str


def read_decision(path: Path) -> Decision:
    """Read the head of a decision, and check that it says when to reopen it.

    Args:
        path: of the file.

    Raises:
        ValueError: the file does not have the form that ``docs/contributing.md`` gives.
    """
    text = path.read_text()
    found = _FORM.match(text)
    if found is None:
        raise ValueError(f"{path.name}: the head does not follow docs/contributing.md, section Decisions")
    if re.search(r"^## Reopen if\n+\S", text, re.MULTILINE) is None:
        raise ValueError(f"{path.name}: the section 'Reopen if' is missing or empty; say what would change the answer")
    head = {name: " ".join(text.split()) for name, text in found.groupdict().items()}
    if not path.name.startswith(f"{head['number']}-"):
        raise ValueError(f"{path.name}: the title has number {head['number']}; use the number of the file's name")
    if head["topic"] not in TOPICS:
        raise ValueError(f"{path.name}: topic {head['topic']!r} is not one of {', '.join(TOPICS)}")
    if _STATUS.fullmatch(head["status"]) is None:
        raise ValueError(f"{path.name}: status {head['status']!r} is not 'in use', 'rejected' or 'replaced by NNNN'")
    return Decision(path.name, **head)


def decisions(folder: Path = FOLDER) -> list[Decision]:
    """Read all decisions, newest first.

    Args:
        folder: folder of the decision log.

    Raises:
        ValueError: a file does not have the form, or a number occurs twice or does not exist.
    """
    found = [read_decision(path) for path in sorted(folder.glob("[0-9]*.md"), reverse=True)]
    numbers = [decision.number for decision in found]
    for decision in found:
        if numbers.count(decision.number) > 1:
            raise ValueError(f"{decision.file}: the number {decision.number} occurs twice; use the next free one")
        other = decision.status.removeprefix("replaced by ")
        if other.isdigit() and other not in numbers:
            raise ValueError(f"{decision.file}: status names decision {other}, which does not exist")
    return found


def index_of(found: list[Decision]) -> str:
    """Return the text of the index.

    Args:
        found: decisions, newest first.
    """
    lines = [
        "# Decisions by topic",
        "",
        "Each file answers one question with figures. Rejected ideas stay in the log. `make reports` writes this page.",
        "[Contributing](../contributing.md#decisions) gives the form of a file.",
    ]
    for topic in TOPICS:
        of_topic = [decision for decision in found if decision.topic == topic]
        if of_topic:
            lines += ["", f"## {topic.capitalize()}", "", "| decision | date | status |", "|---|---|---|"]
            lines += [
                f"| [{each.number}. {each.question}]({each.file}) | {each.date} | {each.status} |" for each in of_topic
            ]
    return "\n".join(lines) + "\n"


def write_index() -> None:
    """Write ``docs/decisions/index.md``."""
    INDEX.write_text(index_of(decisions()))


if __name__ == "__main__":
    write_index()
