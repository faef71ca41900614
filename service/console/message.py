"""Convert an explanation to the message of the contract."""

from base64 import b64encode

from service.console.explain import POINT_BYTES, Explanation
from service.contract import schema
from service.contract.convert import answer_from, vector_from


def explanation_message(explanation: Explanation) -> schema.Explanation:
    """Return the message. Images and points are base64, so that the answer is one JSON document.

    Args:
        explanation: an answer with its intermediate images.
    """
    pictures = {name: _text(png) for name, png in explanation.pictures.items()}
    return schema.Explanation(
        answer=answer_from(explanation.located),
        depth=pictures["depth"],
        fused=pictures["fused"],
        view=pictures.get("view"),
        map_depth=pictures.get("map_depth"),
        points=schema.QueryPointCloud(
            origin=vector_from(explanation.origin_m),
            count=len(explanation.points) // POINT_BYTES,
            data=_text(explanation.points),
        ),
    )


def _text(content: bytes) -> str:
    return b64encode(content).decode("ascii")
