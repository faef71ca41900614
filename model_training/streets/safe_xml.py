"""Read XML of unknown origin: no document types, no entities, no downloads, limited size."""

from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from model_training.streets.named_street import LARGEST_BYTES
from service.errors import DatasetError


def read_xml(path: Path, *, root: str, largest_bytes: int = LARGEST_BYTES) -> Element:
    """Read the element tree of a file.

    Args:
        path: of the file.
        root: name of its outermost element.
        largest_bytes: a larger file is refused.

    Raises:
        DatasetError: the file is missing, too large, no XML, incomplete, has another root, or has a document type.
    """
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data

    def refuse(*_: object) -> NoReturn:
        raise DatasetError(
            f"{path}: line {parser.CurrentLineNumber}: a document type (DTD) is not supported, because its entities "
            "can expand without limit; remove the <!DOCTYPE> line",
            field=path.name,
        )

    parser.StartDoctypeDeclHandler = refuse
    try:
        size = path.stat().st_size
        if size > largest_bytes:
            raise DatasetError(
                f"{path}: {size} bytes are more than {largest_bytes}; reduce the map to the surroundings of the survey",
                field=path.name,
            )
        parser.Parse(path.read_bytes(), True)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}", field=path.name) from error
    except expat.ExpatError as error:
        raise DatasetError(
            f"{path}: not valid XML: {error}; the file is incomplete or has another format", field=path.name
        ) from error
    tree: Element = builder.close()
    if tree.tag != root:
        raise DatasetError(
            f"{path}: its root element is <{tree.tag}>, not <{root}>; the file has another format", field=path.name
        )
    return tree
