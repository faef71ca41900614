"""From a message's bytes to the message; bytes that do not parse are an error of ours that names the field at fault."""

from collections.abc import Iterator
from itertools import islice

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from service.errors import RequestError

#: Fields of a message at its top, repeated ones counted each: more make no sense, and each may cost a hundred times its bytes.
MOST_FIELDS = 64

#: Of a message that does not parse, so many fields are searched for the one at fault: the search takes a microsecond for each.
_MOST_WALKED = 256
#: Wire types of the encoding (protobuf.dev/programming-guides/encoding). Groups (3 and 4) are obsolete; we refuse them at the top.
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def parsed(raw: bytes, descriptor: Descriptor) -> Message:
    """A message from its bytes.

    Args:
        raw: as they came.
        descriptor: of the message.

    Raises:
        RequestError: there are more fields than a message of ours has, or the bytes do not parse; its field is the path, in the
            proto's names, of the innermost field that does not parse, and empty where that is the message itself.
    """
    require_few_fields(raw)
    try:
        return _parse(raw, descriptor)
    except DecodeError as error:
        field = _field_at_fault(raw, descriptor)
        where = f"{field}: its bytes are" if field else "the bytes are"
        raise RequestError(
            f"{where} not what the proto describes (text must be UTF-8); use the proto in this service's repository",
            field=field,
        ) from error


def require_few_fields(raw: bytes, *, most: int = MOST_FIELDS) -> None:
    """Walk over the fields of a message without looking into them.

    Raises:
        RequestError: there are more than a message of ours has, or the bytes are no message.
    """
    for count, _ in enumerate(_fields(raw), 1):
        if count > most:
            raise RequestError(
                f"the message has more than {most} fields at its top; send fewer requests or frames at once"
            )


def _parse(raw: bytes, descriptor: Descriptor) -> Message:
    message: Message = GetMessageClass(descriptor).FromString(raw)
    return message


def _field_at_fault(raw: bytes, descriptor: Descriptor) -> str:
    """Path of the innermost field that does not parse; empty where no field of this message is at fault alone."""
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
            # A packed list of numbers is one field of the message, whatever its length.
            counted = field.is_repeated and field.type in (FieldDescriptor.TYPE_MESSAGE, FieldDescriptor.TYPE_STRING)
            name = f"{field.name}.{seen.get(number, 0)}" if counted else str(field.name)
            inner = _field_at_fault(content, field.message_type) if field.message_type is not None else ""
            return f"{name}.{inner}" if inner else name
    except RequestError:  # the message itself is cut off, or no message
        pass
    return ""


def _parses(content: bytes, field: FieldDescriptor, descriptor: Descriptor) -> bool:
    """Whether a length-delimited field's content is what its type says, by the library's own parser."""
    alone = _varint_of(field.number << 3 | _BYTES) + _varint_of(len(content)) + content
    try:
        _parse(alone, descriptor)
    except DecodeError:
        return False
    return True


def _fields(raw: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Number and wire type of each field, and where its content begins and ends; of other than length-delimited ones nothing.

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
    return RequestError("the bytes are no protobuf message; use the proto in this service's repository")
