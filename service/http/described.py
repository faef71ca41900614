"""OpenAPI descriptions that several routes share: bodies of image pairs, and problems."""

from http import HTTPStatus
from typing import Any

from service.contract import schema
from service.http.problems import MEDIA_TYPE

LOCALIZE_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["rgb", "depth", "request"],
                "additionalProperties": False,
                "properties": {
                    "rgb": {"type": "string", "format": "binary", "description": "JPEG, PNG or WebP"},
                    "depth": {
                        "type": "string",
                        "format": "binary",
                        "description": "16-bit PNG, TIFF, NPY or raw16 (SFD1: zstd or lz4, the cheapest). With depth.encoding: "
                        "CARLA's 24-bit PNG (carla), or ROS' compressedDepth (compressed_depth)",
                    },
                    "request": {"$ref": "#/components/schemas/LocalizeRequest"},
                },
            },
            "encoding": {
                "rgb": {"contentType": "image/jpeg, image/png, image/webp"},
                "depth": {"contentType": "image/png, image/tiff, application/octet-stream"},
                "request": {"contentType": "application/json"},
            },
        }
    },
}


def numbered_body(document: str) -> dict[str, Any]:
    """Build the OpenAPI body of several image pairs: rgb0, depth0, rgb1, depth1 and so on, and the JSON.

    Args:
        document: name of the schema of the JSON.
    """
    pictures: dict[str, Any] = {}
    for kind, formats in (("rgb", "as rgb of /v1/localize"), ("depth", "as depth of /v1/localize")):
        for number in range(schema.MOST_FRAMES):
            pictures[f"{kind}{number}"] = {"type": "string", "format": "binary", "description": formats}
    properties = pictures | {"request": {"$ref": f"#/components/schemas/{document}"}}
    content = {
        "type": "object",
        "required": ["rgb0", "depth0", "request"],
        "additionalProperties": False,
        "properties": properties,
    }
    encoding = {"request": {"contentType": "application/json"}}
    return {"required": True, "content": {"multipart/form-data": {"schema": content, "encoding": encoding}}}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Build the OpenAPI responses for the problems of a route.

    Args:
        statuses: HTTP status codes of the problems.
    """
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": HTTPStatus(status).phrase, "content": content} for status in statuses}
