"""The answer to a batch."""

from pydantic import BaseModel, Field

from service.contract.schema import LocalizeAnswer
from service.http.problems import Problem


class Outcome(BaseModel):
    """An answer, or what went wrong."""

    answer: LocalizeAnswer | None
    problem: Problem | None


class BatchAnswer(BaseModel):
    """Outcomes in the order of the requests."""

    outcomes: list[Outcome] = Field(description="one of each is null")
