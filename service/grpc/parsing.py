"""Parse the bytes of a message. If they do not parse, the error names the invalid field."""

from collections.abc import Iterator
from itertools import islice

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from service.errors import RequestError

#: Maximum number of top-level fields of a message; each element of a repeated field counts. No valid message has more, and a field may
#: take a hundred times its bytes in memory.
MOST_FIELDS = 64

#: Maximum number of fields that are searched for the invalid one. The search takes a microsecond per field.
_MOST_WALKED = 256
#: Wire types of the encoding (protobuf.dev/programming-guides/encoding). Groups (3 and 4) are obsolete and refused at the top level.
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def parsed(raw: bytes, descriptor: Descriptor) -> Message:
    """Parse a message from its bytes.

    Args:
        raw: as received.
        descriptor: of the message.

    Raises:
        RequestError: there are more than ``MOST_FIELDS`` fields, or the bytes do not parse. Its ``field`` is the path of the innermost
            field that does not parse, in the names of the proto; empty if no single field is invalid.
    """
    require_few_fields(raw)
    try:
        return _parse(raw, descriptor)
    except DecodeError as error:
        field = _field_at_fault(raw, descriptor)
        where = f"{field}: " if field else ""
        raise RequestError(
            f"{where}the bytes do not match the proto (text must be UTF-8); use the proto in this service's repository",
            field=field,
        ) from error


def require_few_fields(raw: bytes, *, most: int = MOST_FIELDS) -> None:
    """Count the top-level fields of a message without parsing them, and require few.

    Args:
        raw: bytes of the message.
        most: maximum number of fields.

    Raises:
        RequestError: there are more fields, or the bytes are no message.
    """
    for count, _ in enumerate(_fields(raw), 1):
        if count > most:
            raise RequestError(
                f"the message has more than {most} top-level fields; send fewer requests or frames at once"
            )


def _parse(raw: bytes, descriptor: Descriptor) -> Message:
    message: Message = GetMessageClass(descriptor).FromString(raw)
    return message


def _field_at_fault(raw: bytes, descriptor: Descriptor) -> str:
    """Path of the innermost field that does not parse; empty if no single field is invalid."""
    seen: dict[int, int] = {}
    try:
        for number, wire, begin, end in islice(_fields(raw), _MOST_WALKED):
            field = descriptor.fields_by_number.get(number)
            if field is None or wire != _BYTES or field.type == FieldDescriptor.TYPE_BYTES:
                continue
            content = raw[begin:end]
            if _parses(content, field, descriptor):
                seen[number] = seen.get(number, 0) + 1
                continue
            # A packed list of numbers is one field, whatever its length, so its path has no index.
            counted = field.is_repeated and field.type in (FieldDescriptor.TYPE_MESSAGE, FieldDescriptor.TYPE_STRING)
            name = f"{field.name}.{seen.get(number, 0)}" if counted else str(field.name)
            inner = _field_at_fault(content, field.message_type) if field.message_type is not None else ""
            return f"{name}.{inner}" if inner else name
    except RequestError:  # the bytes are cut off, or no message at all
        pass
    return ""


def _parses(content: bytes, field: FieldDescriptor, descriptor: Descriptor) -> bool:
    """Whether the content of a length-delimited field parses as its type, according to the protobuf library."""
    alone = _varint_of(field.number << 3 | _BYTES) + _varint_of(len(content)) + content
    try:
        _parse(alone, descriptor)
    except DecodeError:
        return False
    return True


def _fields(raw: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Yield number, wire type, begin and end of each top-level field.

    Begin and end delimit the content of a length-delimited field. They have no use for other wire types.

    Raises:
        RequestError: the bytes are no message.
    """
    at = 0
    while at < len(raw):
        tag, at = _varint(raw, at)
        wire, begin = tag & 7, at
        if wire == _VARINT:
            _, at = _varint(raw, at)
        elif wire == _FIXED64:
            at += 8
        elif wire == _BYTES:
            length, begin = _varint(raw, at)
            at = begin + length
        elif wire == _FIXED32:
            at += 4
        else:
            raise _no_message()
        if at > len(raw):
            raise _no_message()
        yield tag >> 3, wire, begin, at


def _varint(raw: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(raw):
            break
        byte = raw[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise _no_message()


def _varint_of(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _no_message() -> RequestError:
    return RequestError("the bytes are not a protobuf message; use the proto in this service's repository")
